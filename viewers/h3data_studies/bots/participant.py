"""Scripted participants of a study.

Like a page, they read the consent, pass the checks and the tutorial, play all episodes and fill in the forms. They are
marked as bots (``client.browser`` is ``bot``).
"""

from __future__ import annotations

import asyncio
import hashlib
import math
import random
from collections.abc import Callable, Mapping
from typing import Any

import aiohttp

from h3data_studies.bots.client import BUSY, ENDED, Client

DEVICE = {
    "webgl": True,
    "ping_ms": 1,
    "fps": 60,
    "width": 1280,
    "height": 720,
    "browser": "bot",
    "system": "script",
    "gpu": "none",
}
SAID = "Filled in by a script."
DONE_M = 0.15
"""Distance from its goal within which an object counts as placed, the same as on the page [m]."""
REACTION_STEPS = (8, 20)
"""Least and greatest reaction time of a bot [steps], 0.25 to 0.7 s; in steps it does not depend on the speed of the
clock."""
HESITATES = 0.3
"""Share of decisions before which a bot briefly steers by keys."""
FACES_RAD = 0.1
TRIES = 4
"""Number of places that are tried for an object."""
LATE_S, RETRY_S = 600.0, 1.0
"""Time without a message after which the participant gives up, and time before a refused request is repeated [s]."""


class ScriptedParticipant(Client):
    """Scripted participant, from consent to completion code, whose random choices follow from its name alone."""

    view: dict[str, Any]

    def __init__(
        self,
        link: str,
        name: str,
        report: Callable[[str], None] = lambda _: None,
        *,
        pid: str = "",
        rejoin: str = "",
        right: Mapping[tuple[str, str], float] | None = None,
    ) -> None:
        """Connect a participant to a study.

        Args:
            link: link of the study.
            name: name that seeds all random choices.
            report: called with the reason why an episode ended.
            pid: PROLIFIC_PID of the participant (default: 24 hexadecimal digits that follow from the name).
            right: correct answers to checks, by form and item, which pages do not know.
            rejoin: code by which it continues an earlier participation (`h3data_studies.pseudonyms.rejoin_code`).
        """
        super().__init__(link)
        self.name, self.report, self.rejoin, self.right = name, report, rejoin, right or {}
        self.pid = pid or hashlib.sha256(name.encode()).hexdigest()[:24]
        self.chance = random.Random(name)
        """Random generator of the episode."""

    # --- the study ----------------------------------------------------------------------------------------------------
    async def take_part(self) -> str:
        """Take part in the study to the end, and return the final status (``complete``, ``screened_out``, ...)."""
        ids = {"PROLIFIC_PID": self.pid, "STUDY_ID": "bots", "SESSION_ID": self.name}
        await self._ask("api/study", {"ids": ids, "rejoin": self.rejoin})
        while (kind := self.stage["kind"]) != "end":
            if kind == "consent":
                await self._ask("api/study/consent", {"accept": True, "hash": self.stage["hash"], "ids": ids})
            elif kind == "device":
                await self._ask("api/study/device", DEVICE)
            elif kind == "form":
                await self._ask(
                    "api/study/form",
                    {
                        "form": self.stage["form"],
                        "block": self.stage["block"],
                        "trial": self.stage["trial"],
                        "answers": self.answers(),
                    },
                )
            else:
                await self._episode(is_tutorial=kind == "tutorial")
                await self._ask("api/study")
        return str(self.stage["status"])

    @property
    def stage(self) -> dict[str, Any]:
        """Return the description of the participant's next stage."""
        return self.view["stage"]

    def answers(self) -> dict[str, Any]:
        """Return answers to the items of the next form, at random if an item has no right answer."""
        chance = random.Random(f"{self.name}/{self.stage['form']}/{self.view['progress']['done']}")
        answers: dict[str, Any] = {}
        for item in self.stage["items"]:
            if (self.stage["form"], item["id"]) in self.right:
                answers[item["id"]] = self.right[self.stage["form"], item["id"]]
            elif item["kind"] == "scale":
                answers[item["id"]] = chance.randrange(
                    int(item["min"]), int(item["max"]) + 1, int(item.get("step") or 1)
                )
            elif item["kind"] == "choice":
                answers[item["id"]] = chance.randrange(len(item["options"]))
            elif item["kind"] == "number":
                answers[item["id"]] = chance.randint(int(item.get("min") or 0), int(item.get("max") or 100))
            else:
                answers[item["id"]] = SAID
        return answers

    async def _ask(self, path: str, body: dict[str, Any] | None = None) -> None:
        """Post a request and store the returned view; repeat the request while the server is busy.

        Raises:
            ConnectionError: it was refused for good.
        """
        while True:
            async with self.http.post(self.link + path, json=body or {}) as answer:
                if answer.status == 200:
                    self.view = await answer.json()
                    return
                said = await answer.text()
                if answer.status != 503:
                    raise ConnectionError(f"{path}: {answer.status} {said}")
            await asyncio.sleep(RETRY_S)

    # --- an episode ---------------------------------------------------------------------------------------------------
    async def _episode(self, *, is_tutorial: bool) -> None:
        """Play the next episode to its end, also when connections are lost."""
        while True:
            status = await self.sit()
            while status == 503:
                await asyncio.sleep(RETRY_S)
                status = await self.sit()
            if status in (409, 410):  # the episode has ended meanwhile
                return
            if status != 200:
                raise ConnectionError(f"{status} {self.told[-1]}")
            self.chance = random.Random(f"{self.name}/{self.view['progress']['done']}")
            try:
                await self.connect()
                await self.until(lambda: self.step, LATE_S)
                self.seq = self.ack + 1
                await self._play()
                if self.manifest["asks"]:
                    await self.until(lambda: self.heard("question") or self.heard("over"), LATE_S)
                    if not self.heard("over"):
                        await self.send(k="answer", answer=self.chance.choice(("yes", "no", "unsure")), text=SAID)
                over = (await self.until(lambda: self.heard("over"), LATE_S))[0]
            except (ConnectionError, aiohttp.ClientError):
                if self.heard("over"):
                    return
                await asyncio.sleep(RETRY_S)
                continue
            self.report("tutorial" if is_tutorial else over["ended"])
            return

    async def _play(self) -> None:
        """Make decisions until the episode is over, and answer the question that follows."""
        self.tried: set[int] = set()
        while not self.over:
            await self._pause(self.chance.randint(*REACTION_STEPS))
            if self.over:
                return
            marker = (self.heard("hud") or [{}])[-1].get("marker")
            if marker:
                await self._do(k="goto", p=marker)
            elif self.manifest["spots"]:
                await self._words()
            elif not self.manifest["goals"]:
                await self._stroll()
            elif 0 <= self.mine < len(self.manifest["goals"]):
                await self._do(k="place", p=self.manifest["goals"][self.mine]["position"], lead=True)
            else:
                await self._fetch()

    async def _fetch(self) -> None:
        """Take the nearest object that is not at its goal, once the object and its goal are not enclosed.

        Waits while another agent has all of them.
        """
        x, z, _ = self.bases[self.me]
        open_ = [k for k in range(len(self.manifest["goals"])) if not self._is_done(k) and self.things[k].held < 0]
        if not open_:
            await self._pause(30)
            return
        if self.chance.random() < HESITATES:
            await self._steer(12)
        gaps = {k: math.hypot(self.things[k].position[0] - x, self.things[k].position[2] - z) for k in open_}
        nearest = min(gaps, key=gaps.__getitem__)
        if (joint := self._barrier(nearest)) >= 0:
            await self._do(k="open", j=joint, lead=True)
            return
        refusals = len(self.heard("why"))
        await self._do(k="pick", o=nearest, lead=True)
        if len(self.heard("why")) > refusals:
            await self._face(self.things[nearest].position)  # the tutorial asks for it

    async def _words(self) -> None:
        """Do the next part of an instruction in words, as far as names in it tell; end the task when nothing is left.

        It knows no grammar, and completes the simple ones of the tasks.
        """
        hud = self.heard("hud")[-1]
        task, things = str(hud["task"]), self.manifest["objects"]
        named = sorted((task.find(one["label"]), k) for k, one in enumerate(things) if one["label"] in task)
        # who plays along brings what they have taken
        others = [k for _, k in named if self.things[k].held not in (-1, self.me)]
        self.tried.update(k for k in others if self.manifest["agents"][self.things[k].held]["kind"] == "human")
        open_ = [k for _, k in named if k not in self.tried]
        left = [k for k in open_ if self.things[k].held in (-1, self.me)]
        useful = [k for _, k in named if k < len(hud["uses"]) and hud["uses"][k] and k in left]
        if self.mine >= 0 and self.mine not in self.tried:
            await self._bring(task)
        elif useful:
            if self.chance.random() < HESITATES:
                await self.send(k="say", text=self.chance.choice(self.manifest["phrases"])["text"])
            await self._do(k="use", o=useful[0], lead=True)
            await self._pause(25)
            if self.heard("hud")[-1]["uses"] == hud["uses"]:
                self.tried.add(useful[0])
        elif left:
            await self._do(k="pick", o=left[0], lead=True)
            if self.mine != left[0]:
                self.tried.add(left[0])
        elif open_ or others:  # somebody else has the rest in their hands
            await self._pause(30)
        else:
            await self._do(k="end", why="finished")
            await self.until(lambda: self.over, LATE_S)

    async def _bring(self, task: str) -> None:
        """Bring the held object to a place whose name is in the instruction, or drop it."""
        held = self.mine
        spots = [spot for spot in self.manifest["spots"] if _noun(spot["label"]) in task]
        # things come from where an instruction names first, and go to where it names last
        spots.sort(key=lambda spot: (task.rfind(_noun(spot["label"])), task.rfind(spot["room"])), reverse=True)
        self.tried.add(held)
        for spot in spots[:TRIES]:
            await self._do(k="bring", place=spot["name"])
            if self.mine != held or self.over:
                return
        if not self.over:
            await self._do(k="drop")

    async def _stroll(self) -> None:
        await self._steer(30)

    async def _steer(self, steps: int) -> None:
        await self.send(k="move", f=round(self.chance.uniform(0.0, 0.6), 2), t=round(self.chance.uniform(-0.5, 0.5), 2))
        await self._pause(steps)
        if not self.over:
            await self.send(k="move", f=0, t=0)

    async def _face(self, point: tuple[float, float, float]) -> None:
        """Turn towards a point and look at it for a while."""

        def left() -> float:
            x, z, heading = self.bases[self.me]
            return math.remainder(math.atan2(z - point[2], point[0] - x) - heading, math.tau)

        if abs(left()) > FACES_RAD:
            side = math.copysign(0.4, left())
            await self.send(k="move", f=0, t=side)
            await self.until(lambda: self.over or left() * side < FACES_RAD * abs(side), LATE_S)
            if not self.over:
                await self.send(k="move", f=0, t=0)
        await self._pause(25)

    async def _do(self, **message: Any) -> None:
        """Request an action and wait until it is done, or has been refused."""
        seq = await self.send(**message)
        await self.until(lambda: self.over or (self.ack >= seq and not self.flags & BUSY), LATE_S)

    async def _pause(self, steps: int) -> None:
        until = self.step + steps
        await self.until(lambda: self.over or self.step >= until, LATE_S)

    @property
    def over(self) -> bool:
        """Return whether the episode has ended."""
        return bool(self.flags & ENDED or self.heard("over"))

    @property
    def me(self) -> int:
        """Number of the participant's agent."""
        return int(self.manifest["me"])

    @property
    def mine(self) -> int:
        """Index of the object that the bot holds; -1 if none."""
        return next((k for k, thing in enumerate(self.things) if thing.held == self.me), -1)

    def _barrier(self, k: int) -> int:
        """Return door or drawer to open before thing ``k`` is taken, for its goal or for the thing itself; -1: none."""
        told = self.heard("barriers")
        own, of_goal = told[-1][k] if told else (-1, -1)
        return of_goal if of_goal >= 0 else own

    def _is_done(self, k: int) -> bool:
        thing, goal = self.things[k], self.manifest["goals"][k]["position"]
        return thing.held < 0 and math.dist(thing.position, goal) < DONE_M


def _noun(label: str) -> str:
    """Return the name of the furniture in the label of a place."""
    return label.removeprefix("on the ").removeprefix("inside the ").partition(" (")[0]
