"""Parser of BVH files (Biovision Hierarchy): a tree of joints with offsets, then a line of channel values per frame."""

from __future__ import annotations

import re
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from h3data.errors import FormatError, InputError
from h3data.geometry import Array, quat_from_axis_angle, quat_multiply, quat_rotate

MAX_BYTES = 1 << 29
MAX_JOINTS = 1024
CHANNELS = {f"{axis}{kind}".lower(): (kind, k) for kind in ("position", "rotation") for k, axis in enumerate("XYZ")}

_COMMENT = re.compile(r"(^|\s)(#|//).*")


class BvhWarning(UserWarning):
    """Warning about a file with one frame more or less than it states, as some programs write."""


@dataclass(frozen=True, kw_only=True)
class BvhJoint:
    """Joint of a BVH skeleton; end sites are joints without channels."""

    name: str
    parent: int
    """Index of the parent; -1 for a root."""
    offset: tuple[float, float, float]
    """Position of the joint in its parent's frame, in the units of the file."""
    channels: tuple[str, ...]
    """Names of the channels in lower case, in the order of their values; rotations are applied in this order."""
    end_site: bool = False


@dataclass(frozen=True, kw_only=True, eq=False)
class Bvh:
    """Parsed BVH file, with angles in degrees and lengths in the units of the file."""

    joints: tuple[BvhJoint, ...]
    """Joints, parents before children."""
    values: Array
    """Channel values, joint by joint, shape [T, C]."""
    frame_s: float
    """Duration of a frame [s]."""

    def rest_places(self) -> Array:
        """Return joint positions without rotations, shape [J, 3] in the units of the file, with the root at its offset."""
        places = np.zeros((len(self.joints), 3))
        for k, joint in enumerate(self.joints):
            places[k] = np.array(joint.offset) + (places[joint.parent] if joint.parent >= 0 else 0)
        return places

    def forward_kinematics(self) -> tuple[Array, Array]:
        """Return the world rotations xyzw [T, J, 4] and positions [T, J, 3] of all joints, in the file's axes and units.

        A position channel replaces that component of the joint's offset, as current exporters write it.
        """
        frames, column = len(self.values), 0
        quats, places = np.empty((frames, len(self.joints), 4)), np.empty((frames, len(self.joints), 3))
        for k, joint in enumerate(self.joints):
            local = np.tile([0.0, 0, 0, 1], (frames, 1))
            offset = np.tile(np.array(joint.offset, np.float64), (frames, 1))
            for channel in joint.channels:
                kind, axis = CHANNELS[channel]
                if kind == "position":
                    offset[:, axis] = self.values[:, column]
                else:  # first channel outermost: v' = R1 R2 R3 v
                    local = quat_multiply(
                        local, quat_from_axis_angle(np.eye(3)[axis], np.radians(self.values[:, column]))
                    )
                column += 1
            if joint.parent < 0:
                quats[:, k], places[:, k] = local, offset
            else:
                quats[:, k] = quat_multiply(quats[:, joint.parent], local)
                places[:, k] = places[:, joint.parent] + quat_rotate(quats[:, joint.parent], offset)
        return quats, places


def read_bvh_file(path: str | Path) -> Bvh:
    """Parse a BVH file.

    Raises:
        FormatError: the text is not a BVH file, or is damaged; the message states the line.
        InputError: there is no such file.
    """
    path = Path(path)
    try:
        if path.stat().st_size > MAX_BYTES:
            raise FormatError(
                f"A BVH file of {path.stat().st_size >> 20} MiB is more than the {MAX_BYTES >> 20} admitted: {path}",
                code="H3-BODY-015",
            )
        text = path.read_bytes().decode("utf-8-sig", errors="replace")
    except OSError as error:
        raise InputError(f"Cannot read a BVH file ({error.strerror or error}): {path}", code="H3-BODY-016") from None
    return parse_bvh(text, str(path))


def parse_bvh(text: str, where: str = "text") -> Bvh:
    """Parse the text of a BVH file like `read_bvh_file`; ``where`` is the name in error messages."""
    reader = _Reader([_COMMENT.sub("", line) for line in text.splitlines()], where)
    joints = _hierarchy(reader)
    reader.expect("MOTION")
    reader.expect_label("Frames:")
    claimed = reader.count("a number of frames")
    reader.expect_label("Frame Time:")
    frame_s = reader.number()
    if not 2e-4 < frame_s < 1e3:
        raise reader.fault(f"expected seconds per frame, got {frame_s:g}")
    columns = sum(len(j.channels) for j in joints)
    return Bvh(joints=joints, values=_values(reader, claimed, columns), frame_s=frame_s)


class _Reader:
    """Words of a text, with the number of their line for errors."""

    def __init__(self, lines: list[str], where: str) -> None:
        self.lines, self.where, self.row, self.words = lines, where, 0, list[str]()

    def peek(self) -> str:
        """Return the next word; empty at the end."""
        while not self.words:
            if self.row >= len(self.lines):
                return ""
            self.words = self.lines[self.row].split()[::-1]
            self.row += 1
        return self.words[-1]

    def word(self, expected: str) -> str:
        if not self.peek():
            raise self.fault(f"the file ends where {expected} should be. Hint: it is cut off, copy it again")
        return self.words.pop()

    def expect(self, keyword: str) -> None:
        found = self.word(keyword)
        if found.lower() != keyword.lower():
            raise self.fault(f"expected {keyword}, got {found[:40]!r}")

    def expect_label(self, label: str) -> None:
        """Read words that end in a colon, apart from the last one or beside what follows: ``Frames:524``."""
        *first, last = label.split()
        for keyword in first:
            self.expect(keyword)
        found = self.word(last)
        head, colon, tail = found.partition(":")
        if not colon and self.peek().startswith(":"):
            colon, tail = ":", self.words.pop()[1:]
        if head.lower() != last[:-1].lower() or not colon:
            raise self.fault(f"expected {last}, got {found[:40]!r}")
        if tail:
            self.words.append(tail)

    def number(self) -> float:
        found = self.word("a number")
        try:
            value = float(found)
        except ValueError:
            raise self.fault(f"expected a number, got {found[:40]!r}") from None
        if not abs(value) < 1e9:
            raise self.fault(f"expected a finite number, got {found[:40]!r}")
        return value

    def count(self, expected: str) -> int:
        found = self.word(expected)
        if not found.isdecimal() or len(found) > 9:
            raise self.fault(f"expected {expected}, got {found[:40]!r}")
        return int(found)

    def rest_of_line(self) -> str:
        text, self.words = " ".join(reversed(self.words)), []
        return text

    def fault(self, text: str) -> FormatError:
        return FormatError(f"BVH line {self.row}: {text}: {self.where}", code="H3-BODY-013")


def _hierarchy(reader: _Reader) -> tuple[BvhJoint, ...]:
    if not reader.peek():
        raise FormatError(f"Expected a BVH file, this one is empty: {reader.where}", code="H3-BODY-014")
    reader.expect("HIERARCHY")
    joints: list[BvhJoint] = []
    names: set[str] = set()
    open_joints: list[int] = []
    while reader.peek().upper() != "MOTION" or open_joints:
        keyword = reader.word("ROOT, JOINT, End Site or }").upper()
        if keyword == "}" and open_joints:
            open_joints.pop()
            continue
        if keyword not in ("ROOT", "JOINT", "END") or (keyword == "ROOT") == bool(open_joints):
            raise reader.fault(f"expected {'JOINT, End Site or }' if open_joints else 'ROOT'}, got {keyword[:40]!r}")
        name = reader.rest_of_line()
        brace = name.endswith("{")  # some write it in the same line
        name = name.removesuffix("{").strip()
        parent = open_joints[-1] if open_joints else -1
        if parent >= 0 and joints[parent].end_site:
            raise reader.fault("an End Site has no children")
        end_site = keyword == "END"
        if not end_site and (not name or name in names):
            raise reader.fault(f"joint {name!r} is there twice" if name else "a joint has no name")
        if not brace:
            reader.expect("{")
        reader.expect("OFFSET")
        offset = (reader.number(), reader.number(), reader.number())
        channels = () if end_site else _channels(reader)
        names.add(name)
        joints.append(
            BvhJoint(name="" if end_site else name, parent=parent, offset=offset, channels=channels, end_site=end_site)
        )
        open_joints.append(len(joints) - 1)
        if len(joints) > MAX_JOINTS:
            raise reader.fault(f"more than {MAX_JOINTS} joints")
    if not joints:
        raise reader.fault("the hierarchy has no joint")
    return tuple(joints)


def _channels(reader: _Reader) -> tuple[str, ...]:
    if reader.peek().upper() != "CHANNELS":
        raise reader.fault(f"expected CHANNELS, got {reader.peek()[:40]!r}")
    reader.word("CHANNELS")
    count = reader.count("a number of channels")
    if count > 6:
        raise reader.fault(f"expected at most 6 channels, got {count}")
    channels = tuple(reader.word("a channel").lower() for _ in range(count))
    unknown = [c for c in channels if c not in CHANNELS]
    if unknown or len(set(channels)) != count:
        what = f"unknown channel {unknown[0][:40]!r}" if unknown else f"a channel twice in {', '.join(channels)}"
        raise reader.fault(f"{what}; expected Xposition, Yposition, Zposition, Xrotation, Yrotation, Zrotation")
    return channels


def _values(reader: _Reader, claimed: int, columns: int) -> Array:
    """Return all numbers after the frame time, shape [T, C]."""
    rest = reader.rest_of_line().split()
    for line in reader.lines[reader.row :]:
        rest += line.split()
    if not columns:
        raise reader.fault("no joint has channels")
    frames, left_over = divmod(len(rest), columns)
    if frames and not left_over and abs(frames - claimed) == 1:
        text = f"BVH: Frames: {claimed}, but the file has {frames}, which are read: {reader.where}"
        warnings.warn(text, BvhWarning, stacklevel=4)
        claimed = frames
    if len(rest) != claimed * columns or not claimed:
        raise reader.fault(
            f"Frames: {claimed} with {columns} channels need {claimed * columns} numbers, there are {len(rest)} "
            f"({len(rest) / columns:.6g} frames). Hint: the file is cut off, or lacks channels"
        )
    try:
        values = np.array(rest, np.float64)
    except ValueError as error:
        raise reader.fault(f"a frame has something that is no number ({error})") from None
    if not np.isfinite(values).all() or np.abs(values).max() > 1e9:
        frame = int(np.nonzero(~(np.abs(values) <= 1e9))[0][0]) // columns
        raise reader.fault(f"frame {frame} has a number that is not finite")
    return values.reshape(claimed, columns)
