"""Script for docs/pictures/remote.jpg: observations in requests to a policy server, and the actions in its answers.

The server speaks openpi's protocol and follows the person by the numbers that it is sent; the pictures are those of the adapter
``openpi``.

python -m bake.sheets.remote docs/pictures/remote.jpg
"""

from __future__ import annotations

import sys
import threading
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from websockets.exceptions import ConnectionClosed
from websockets.sync.server import ServerConnection, serve

import h3data
from h3data_remote.wire import OPENPI
from sim_kinematic.tasks.social_nav import SocialNav

CHUNK, STEPS, PANELS, AWAY_M, FIRST = 5, 400, 5, 2.8, 15
SCENE, SEED = "medium:1", 9
WIDTH, PLOT = 224, 92
COLORS, NAMES = ("#d1495b", "#30638e"), ("forward", "turn")
Request = tuple[NDArray[np.uint8], NDArray[np.float64]]


def answer(state: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a chunk [CHUNK, 2] of forward and turn, for a person at ``state[:2]``: distance [m], angle [rad]."""
    distance, angle = state[:2].tolist()
    forward = np.clip((distance - AWAY_M) * 0.6, -1, 1) if abs(angle) < 0.6 else 0.1
    turns = np.clip(-1.5 * angle * 0.85 ** np.arange(CHUNK), -1, 1)
    return np.stack([np.full(CHUNK, forward), turns], axis=-1)


def requests() -> list[Request]:
    """Play an episode with a server in this process; return the pictures and chunks of all requests."""
    seen: list[Request] = []

    def handle(connection: ServerConnection) -> None:
        connection.send(OPENPI.pack({"name": "follower"}))
        try:
            while True:
                shown: dict[str, Any] = OPENPI.unpack(connection.recv(decode=False))
                chunk = answer(np.asarray(shown["observation/state"], np.float64))
                seen.append((np.asarray(shown["observation/image"]), chunk))
                connection.send(OPENPI.pack({"actions": chunk}))
        except ConnectionClosed:
            return

    with serve(handle, "127.0.0.1", 0, compression=None, max_size=None) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        address = f"ws://127.0.0.1:{server.socket.getsockname()[1]}?adapter=openpi"
        h3data.simulate(SocialNav, SCENE, seed=SEED, max_steps=STEPS, agents={"robot": address})
        server.shutdown()
    return seen


def plot(chunk: NDArray[np.float64]) -> Image.Image:
    """Return the actions of a chunk as bars from -1 to 1."""
    picture = Image.new("RGB", (WIDTH, PLOT), "white")
    pen, middle, wide = ImageDraw.Draw(picture), PLOT // 2, WIDTH / (3 * CHUNK + 1)
    pen.line((0, middle, WIDTH, middle), "#999999")
    for k, action in enumerate(chunk.tolist()):
        for column, value in enumerate(action):
            left, end = wide * (3 * k + column + 1), middle - value * (middle - 12)
            pen.rectangle((left, min(end, middle), left + wide - 2, max(end, middle)), COLORS[column])
    for column, name in enumerate(NAMES):
        pen.text((4 + 64 * column, PLOT - 15), name, COLORS[column], ImageFont.load_default(12))
    return picture


def main(out: str) -> None:
    """Play the episode and write the picture."""
    seen = requests()
    sheet = Image.new("RGB", ((WIDTH + 4) * PANELS - 4, WIDTH + 18 + PLOT), "white")
    for n, index in enumerate(np.linspace(FIRST, len(seen) - 5, PANELS).astype(int).tolist()):
        left, (image, chunk) = n * (WIDTH + 4), seen[index]
        sheet.paste(Image.fromarray(image), (left, 18))
        sheet.paste(plot(chunk), (left, 18 + WIDTH))
        ImageDraw.Draw(sheet).text((left + 2, 2), f"step {index * CHUNK}", "black", ImageFont.load_default(13))
    sheet.save(out, quality=80, optimize=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
