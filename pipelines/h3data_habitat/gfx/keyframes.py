"""Reading of the keyframes of a gfx-replay file one by one, as typed records.

The format stores changes: a keyframe holds what is new since the one before (spec/habitat.md 5.1). Empty lists are left
out, unknown members are ignored, and the enumeration ``type``, which changed over the years, is never used.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from itertools import chain
from pathlib import Path
from typing import Annotated, Any, TypeVar

import msgspec

from h3data.errors import FormatError
from h3data.formats import SourceFile, json_format
from h3data.formats.builtin_formats import REPLAY_MEMBERS
from h3data.formats.source_file import BYTE_ORDER_MARK, decode_json
from h3data_habitat.json_files import not_json, truncated
from h3data_habitat.json_stream import ArrayElements, ArrayFault

Number = Annotated[float, msgspec.Meta(ge=-1e9, le=1e9)]
"""Number that stays within the range of float32 even after a product or two."""
Vec3 = tuple[Number, Number, Number]
Quat = tuple[Number, Number, Number, Number]
Key = Annotated[int, msgspec.Meta(ge=0)]


class Transform(msgspec.Struct):
    """Transform in a keyframe; ``rotation`` is w x y z."""

    translation: Vec3
    rotation: Quat


class Frame(msgspec.Struct):
    """Axes of an asset's file that point up and to the front."""

    up: Vec3 = (0.0, 1.0, 0.0)
    front: Vec3 = (0.0, 0.0, -1.0)


class Phong(msgspec.Struct):
    """Material that replaces the one in an asset's file."""

    diffuse: Annotated[list[Number], msgspec.Meta(min_length=3)] | None = None


class Load(msgspec.Struct):
    """Asset that is loaded from a file."""

    filepath: str
    frame: Frame = msgspec.field(default_factory=Frame)
    virtualUnitToMeters: Annotated[float, msgspec.Meta(gt=0, le=1e9)] = 1.0
    overridePhongMaterial: Phong | None = None


class Creation(msgspec.Struct):
    """Properties of an instance of an asset."""

    filepath: str
    scale: Vec3 = (1.0, 1.0, 1.0)
    isStatic: bool = False
    rigId: int = -1


class CreationItem(msgspec.Struct):
    """Instance that is created in a keyframe."""

    instanceKey: Key
    creation: Creation


class State(msgspec.Struct):
    """Pose of an instance."""

    absTransform: Transform
    semanticId: int | None = None


class StateItem(msgspec.Struct):
    """Change of an instance's pose in a keyframe."""

    instanceKey: Key
    state: State


class Metadata(msgspec.Struct):
    """Semantic and object ids of an instance."""

    semanticId: int | None = None
    objectId: int | None = None


class MetadataItem(msgspec.Struct):
    """Ids of an instance in a keyframe."""

    instanceKey: Key
    metadata: Metadata


class BonePose(msgspec.Struct):
    """Pose of a bone: translation and rotation."""

    t: Vec3
    r: Quat


class RigCreation(msgspec.Struct):
    """Skeleton that is created in a keyframe."""

    id: int
    boneNames: list[str] = []


class RigUpdate(msgspec.Struct):
    """Poses of the bones of a skeleton in a keyframe."""

    id: int
    pose: list[BonePose]


class UserTransform(msgspec.Struct):
    """Named transform that the recording program added, such as a camera's."""

    name: str
    transform: Transform


class Keyframe(msgspec.Struct):
    """Changes of the scene between two frames."""

    loads: list[Load] = []
    rigCreations: list[RigCreation] = []
    creations: list[CreationItem] = []
    metadata: list[MetadataItem] = []
    deletions: list[Key] = []
    stateUpdates: list[StateItem] = []
    rigUpdates: list[RigUpdate] = []
    userTransforms: list[UserTransform] = []
    lights: msgspec.Raw = msgspec.Raw()
    """JSON text of the list of lights."""
    lightsChanged: bool = False


_Kind = TypeVar("_Kind")


class _File(msgspec.Struct):
    keyframes: list[msgspec.Raw] | None = None
    keyframe: msgspec.Raw = msgspec.Raw()


KEYFRAME_BYTES = 64 << 20
"""Largest size of one keyframe, and of the text after the keyframes [bytes]."""
WHOLE_BYTES = 256 << 20
"""Largest size of files that do not start with their keyframes and are read as a whole [bytes]."""

_OPENING = re.compile(rb"""[ \t\r\n]*\{[ \t\r\n]*"keyframes"[ \t\r\n]*:[ \t\r\n]*\[""")
_OPENING_BYTES = 4096


class Undecodable(Exception):
    """Text of a file that cannot be decoded as the expected type.

    `explain` makes an error for users of it.
    """

    def __init__(
        self, text: bytes, fault: msgspec.DecodeError | None = None, *, keyframe: int = -1, start: int = 0
    ) -> None:
        """Store the text and its position in the file.

        Args:
            text: Text of a keyframe, or of the whole file.
            fault: Reason that msgspec gives; None: a file without keyframes.
            keyframe: Number of the keyframe; -1 stands for the whole file.
            start: Number of the first byte of ``text`` in the file.
        """
        super().__init__(str(fault or ""))
        self.text, self.fault, self.keyframe, self.start = text, fault, keyframe, start


def read_keyframes(file: SourceFile, digest: Callable[[bytes], object]) -> Iterator[Keyframe]:
    """Yield the keyframes of a ``.gfx_replay.json`` or ``.json.gz``, or of a single ``{"keyframe": {...}}``.

    A file that begins with its keyframes, as Habitat writes it, is never held in memory as a whole. ``digest`` is called
    with the (unpacked) text of the file, piece by piece. An error may come after many keyframes.

    Raises:
        Undecodable, ArrayFault: the text is no gfx-replay.
        FormatError: there are no keyframes, they hold nothing of a gfx-replay, or they are too long.
    """
    path = file.path
    number, known, strange = -1, False, list[str]()
    for number, (start, text) in enumerate(_texts(file, digest)):
        keyframe = _decoded(text, Keyframe, number, start)
        # looked at until one member is known: later keyframes need not be decoded twice
        if not known:
            members = list(_decoded(text, dict[str, msgspec.Raw], number, start))
            known = not REPLAY_MEMBERS.isdisjoint(members)
            strange = strange or members
        yield keyframe
    if number < 0:
        raise FormatError(f"A gfx-replay without keyframes: there is nothing to import. {path}", code="H3-HABITAT-060")
    if strange and not known:
        held = ", ".join(strange[:8])
        raise FormatError(
            f"Expected a gfx-replay, but its keyframes hold nothing of one; the first has {held}. {path}",
            code="H3-HABITAT-061",
        )


def _texts(file: SourceFile, digest: Callable[[bytes], object]) -> Iterator[tuple[int, bytes]]:
    """Yield the first byte and the text of each keyframe."""

    def digested() -> Iterator[bytes]:
        for chunk in file.chunks():
            digest(chunk)
            yield chunk

    chunks, head = digested(), b""
    while len(head) < _OPENING_BYTES and (chunk := next(chunks, b"")):
        head += chunk
    # habitat-sim writes the keyframes first, so that most files are read one keyframe at a time
    opening = _OPENING.match(head, len(BYTE_ORDER_MARK) if head.startswith(BYTE_ORDER_MARK) else 0)
    if opening:
        yield from _streamed(file.path, head, opening.end(), chunks)
        return
    data = _limited(file.path, head, chunks, WHOLE_BYTES, "a gfx-replay that does not begin with its keyframes")
    document = _decoded(data, _File)
    single = bytes(document.keyframe)
    if document.keyframes is None and not single:
        raise Undecodable(data)
    yield from ((0, bytes(text)) for text in (document.keyframes if document.keyframes is not None else [single]))


def _streamed(path: Path, head: bytes, start: int, chunks: Iterator[bytes]) -> Iterator[tuple[int, bytes]]:
    """Yield the first byte and the text of each keyframe.

    ``head`` is the beginning of the file; the list opens before ``start``.
    """
    elements = ArrayElements(chain([head[start:]], chunks), start, KEYFRAME_BYTES)
    yield from elements
    # what follows is read as a document whose list is empty: a second list would replace that
    rest = _limited(path, elements.rest, chunks, KEYFRAME_BYTES, "the part after the keyframes")
    stand_in = b'{"keyframes":[]'
    document = _decoded(stand_in + rest, dict[str, Any], start=elements.rest_at - len(stand_in))
    if document["keyframes"] != []:
        raise FormatError(f"Not a valid gfx-replay: it has two lists of keyframes: {path}", code="H3-HABITAT-062")


def _limited(path: Path, head: bytes, chunks: Iterator[bytes], most: int, what: str) -> bytes:
    parts, size = [head], len(head)
    for chunk in chunks:
        parts.append(chunk)
        size += len(chunk)
        if size > most:
            raise FormatError(
                f"Not a valid gfx-replay: {what} is longer than {most >> 20} MiB: {path}", code="H3-HABITAT-064"
            )
    return b"".join(parts)


def _decoded(text: bytes, kind: type[_Kind], keyframe: int = -1, start: int = 0) -> _Kind:
    try:
        return decode_json(text, kind)
    except msgspec.DecodeError as fault:
        raise Undecodable(text, fault, keyframe=keyframe, start=start) from None


# --- faults -----------------------------------------------------------------------------------------------------------
def explain(path: Path, fault: Undecodable | ArrayFault) -> FormatError:
    """Return the error that states where and why a file is not a gfx-replay, and what its format probably is."""
    if isinstance(fault, ArrayFault):
        if str(fault) == "truncated":
            return truncated(path, fault.at)
        return FormatError(
            f"Not a valid gfx-replay: {fault} in its list of keyframes (byte {fault.at}): {path}", code="H3-HABITAT-063"
        )
    text, reason = fault.text, fault.fault
    content, damage = None, None if isinstance(reason, msgspec.ValidationError) else reason
    # text of another shape than expected may also stop being JSON further on
    if damage is None and fault.keyframe < 0:
        try:
            content = decode_json(text)
        except msgspec.DecodeError as found:
            damage = found
    if damage is not None:
        return not_json(path, text, damage, start=fault.start)
    is_replay = isinstance(content, dict) and not content.keys().isdisjoint(("keyframes", "keyframe"))
    if fault.keyframe >= 0 or (reason is not None and is_replay):
        what, _, where = str(reason).partition(" - at `")
        place = _place(fault, where.rstrip("`").removeprefix("$").removeprefix("."))
        return FormatError(
            f"Not a valid gfx-replay: {what[:1].lower() + what[1:]} at {place}: {path}", code="H3-HABITAT-059"
        )
    if isinstance(content, dict):
        keys = ", ".join(list(content)[:8]) or "none"
        shape = f"Its top-level keys are: {keys}; it looks like {json_format(content, name=path.name).title}."
    else:
        shape = f"It holds a JSON {type(content).__name__}."
    return FormatError(f"Expected a gfx-replay (JSON with the key 'keyframes'). {shape} {path}", code="H3-HABITAT-058")


def _place(fault: Undecodable, where: str) -> str:
    """Return the name of the place ``where`` (a path of members and indices) of a fault; instances are named by key."""
    if fault.keyframe < 0:
        return where or "its top level"
    place = f"keyframe {fault.keyframe}"
    match = re.match(r"(\w+)(?:\[(\d+)\])?", where)
    if match is None:
        return place
    group, index = match.groups()
    item = None if index is None else _item(fault.text, group, int(index))
    key = item.get("instanceKey", item.get("id", item.get("name"))) if isinstance(item, dict) else None
    number = f", instance {key}" if key is not None else f"[{index}]" if index is not None else ""
    return f"{place}, {group}{number} ({where})"


def _item(text: bytes, group: str, index: int) -> Any:
    try:
        # msgspec refuses numbers that are too large, which may be the fault to explain
        return json.loads(text)[group][index]
    # a member may occur twice
    except (ValueError, RecursionError, LookupError, TypeError):
        return None
