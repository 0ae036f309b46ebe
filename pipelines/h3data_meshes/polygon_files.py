"""Conversion of OBJ and PLY files with polygons to files with triangles of the same area, for trimesh.

Files with triangles only are returned unchanged. So are files that cannot be parsed, for which trimesh then reports the
error.
"""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import Array
from h3data_meshes.polygons import triangulated

# --- OBJ ----------------------------------------------------------------------------------------------------------------
_OBJ_POLYGON = re.compile(rb"^[ \t]*f(?:[ \t]+[^\s#]+){4,}", re.MULTILINE)


def obj_of_triangles(data: bytes) -> bytes:
    """Return an OBJ file's bytes with every face of more than three corners cut into triangles."""
    data = re.sub(rb"\\\r?\n", b" ", data)
    if not _OBJ_POLYGON.search(data):
        return data
    lines = data.splitlines()
    points: list[list[bytes]] = []
    faces: list[tuple[int, list[bytes], int]] = []  # line, corners, vertices before it
    for number, line in enumerate(lines):
        words = line.split(b"#", 1)[0].split()
        if not words:
            continue
        if words[0] == b"v":
            points.append(words[1:4])
        elif words[0] == b"f" and len(words) > 4:
            faces.append((number, words[1:], len(points)))
    try:
        places = np.array(points, np.float64).reshape(-1, 3)
        index = np.array([_obj_index(word, before) for _, corners, before in faces for word in corners])
        corners = places[index]
    except (ValueError, IndexError):
        return data
    triangles, owner = triangulated(corners, np.array([len(corners) for _, corners, _ in faces]))
    words = [word for _, corners, _ in faces for word in corners]
    cut: dict[int, list[bytes]] = {}
    for (a, b, c), face in zip(triangles.tolist(), owner.tolist(), strict=True):
        cut.setdefault(faces[face][0], []).append(b"f %b %b %b" % (words[a], words[b], words[c]))
    return b"\n".join(b"\n".join(cut[k]) if k in cut else line for k, line in enumerate(lines)) + b"\n"


def _obj_index(word: bytes, before: int) -> int:
    """Return the vertex of a corner such as ``3/1/2``: from 1 on, or backwards from the last one before."""
    number = int(word.split(b"/", 1)[0])
    return number - 1 if number > 0 else before + number if -before <= number < 0 else -(1 << 60)


# --- PLY ----------------------------------------------------------------------------------------------------------------
_PLY_NAMES = {"b": "char int8", "B": "uchar uint8", "h": "short int16", "H": "ushort uint16", "i": "int int32"}
_PLY_NAMES |= {"I": "uint uint32", "f": "float float32", "d": "double float64"}
_PLY_TYPES = {name: kind for kind, names in _PLY_NAMES.items() for name in names.split()}


@dataclass(eq=False)
class _Element:
    name: str
    count: int
    properties: list[tuple[str, str | None, str]] = field(default_factory=list)
    """Name, type of a list's length (None: no list), type of the value."""
    raw: bytes = b""
    """Bytes, or lines, of an element other than the faces and without lists."""
    rows: list[list[Array]] = field(default_factory=list)
    """Values of each property by row; for the faces and elements with lists."""

    @property
    def scalar(self) -> bool:
        return self.name != "face" and not any(length for _, length, _ in self.properties)

    def columns(self, form: str) -> Array:
        """Return values [count, properties] of an element without lists."""
        if form == "ascii":
            return np.array(self.raw.split(), np.float64).reshape(self.count, -1)
        table = np.frombuffer(self.raw, [(p[0], _order(form) + _PLY_TYPES[p[2]]) for p in self.properties], self.count)
        return np.stack([table[p[0]].astype(np.float64) for p in self.properties], -1)


def ply_of_triangles(data: bytes) -> bytes:
    """Return a PLY file's bytes with every face of more than three corners cut into triangles."""
    try:
        return _ply_of_triangles(data)
    except (ValueError, KeyError, IndexError, struct.error, UnicodeDecodeError, StopIteration):
        return data


def _ply_of_triangles(data: bytes) -> bytes:
    end = re.search(rb"^end_header[ \t]*\r?\n", data, re.MULTILINE)
    if end is None:
        return data
    header = [line.strip() for line in data[: end.start()].decode("ascii", "surrogateescape").splitlines()]
    form = next(line.split()[1] for line in header if line.startswith("format"))
    elements: list[_Element] = []
    for words in (line.split() for line in header):
        if words[:1] == ["element"]:
            elements.append(_Element(words[1], int(words[2])))
        elif words[:2] == ["property", "list"]:
            elements[-1].properties.append((words[4], words[2], words[3]))
        elif words[:1] == ["property"]:
            elements[-1].properties.append((words[2], None, words[1]))
    face = next(e for e in elements if e.name == "face")
    corners_at = next(k for k, p in enumerate(face.properties) if p[0] in ("vertex_index", "vertex_indices") and p[1])
    body = data[end.end() :]
    if not _has_polygons(body, form, elements, face, corners_at):
        return data
    _read_rows(body, form, elements)
    vertex = next(e for e in elements if e.name == "vertex")
    axes = [[p[0] for p in vertex.properties].index(axis) for axis in "xyz"]
    points = vertex.columns(form)[:, axes]
    polygons = [row[corners_at].astype(np.int64) for row in face.rows]
    counts = np.array([len(p) for p in polygons])
    index = np.concatenate([np.zeros(0, np.int64), *polygons])
    if index.min(initial=0) < 0:
        return data
    triangles, owner = triangulated(points[index], counts)
    triangles = triangles - (np.cumsum(counts) - counts)[owner][:, None]
    rows = []
    for cut, number in zip(triangles, owner.tolist(), strict=True):
        row, size = face.rows[number], len(polygons[number])
        rows.append([_picked(v, cut, size) if p[1] else v for v, p in zip(row, face.properties, strict=True)])
    face.rows, face.count = rows, len(rows)
    return _written(header, form, elements)


def _picked(values: Array, cut: NDArray[np.int64], size: int) -> Array:
    """Return the part of a face's list that belongs to three of its corners; lists that are not per corner stay."""
    return values.reshape(size, -1)[cut].ravel() if len(values) and len(values) % size == 0 else values


def _has_polygons(body: bytes, form: str, elements: list[_Element], face: _Element, corners_at: int) -> bool:
    """Return False if all faces are triangles, as in most large files; binary files are not read row by row for it."""
    before = elements[: elements.index(face)]
    if form == "ascii":
        start = sum(e.count for e in before)
        lines = [line for line in body.splitlines() if line.strip()][start : start + face.count]
        return corners_at > 0 or any(line.split(None, 1)[0] != b"3" for line in lines)
    if not all(e.scalar for e in before):
        return True
    order = _order(form)
    start = sum(e.count * struct.calcsize("<" + "".join(_PLY_TYPES[p[2]] for p in e.properties)) for e in before)
    at, fields = start, []
    for name, length, kind in face.properties:
        if length is None:
            fields.append((name, order + _PLY_TYPES[kind]))
            at += struct.calcsize(_PLY_TYPES[kind])
            continue
        count = int(struct.unpack_from(order + _PLY_TYPES[length], body, at)[0])
        at += struct.calcsize(_PLY_TYPES[length]) + count * struct.calcsize(_PLY_TYPES[kind])
        fields += [(f"{name}#", order + _PLY_TYPES[length]), (name, order + _PLY_TYPES[kind], (count,))]
    dtype = np.dtype(fields)
    if start + face.count * dtype.itemsize > len(body):
        return True
    table = np.frombuffer(body, dtype, face.count, start)
    name = face.properties[corners_at][0]
    same = (
        all((table[f"{p[0]}#"] == table[f"{p[0]}#"][0]).all() for p in face.properties if p[1]) if face.count else True
    )
    return not (same and (not face.count or table[f"{name}#"][0] == 3))


def _order(form: str) -> str:
    return ">" if "big" in form else "<"


def _read_rows(body: bytes, form: str, elements: list[_Element]) -> None:
    if form == "ascii":
        lines = iter([line for line in body.splitlines() if line.strip()])
        for element in elements:
            if element.scalar:
                element.raw = b"".join(next(lines) + b"\n" for _ in range(element.count))
                continue
            for _ in range(element.count):
                words, at, row = next(lines).split(), 0, []
                for _, length, _ in element.properties:
                    count = 1 if length is None else int(float(words[at]))
                    at += 0 if length is None else 1
                    if at + count > len(words):
                        raise ValueError("a row is cut off")
                    row.append(np.array(words[at : at + count], np.float64))
                    at += count
                element.rows.append(row)
        return
    order, at = _order(form), 0
    for element in elements:
        if element.scalar:
            size = element.count * struct.calcsize("<" + "".join(_PLY_TYPES[p[2]] for p in element.properties))
            element.raw, at = body[at : at + size], at + size
            continue
        for _ in range(element.count):
            row = []
            for _, length, kind in element.properties:
                count = 1
                if length is not None:
                    count = int(struct.unpack_from(order + _PLY_TYPES[length], body, at)[0])
                    at += struct.calcsize(_PLY_TYPES[length])
                row.append(np.array(struct.unpack_from(f"{order}{count}{_PLY_TYPES[kind]}", body, at), np.float64))
                at += struct.calcsize(f"<{count}{_PLY_TYPES[kind]}")
            element.rows.append(row)


def _written(header: list[str], form: str, elements: list[_Element]) -> bytes:
    """Return the file again, in its own order of bytes or as text."""
    face = next(e for e in elements if e.name == "face")
    header = [f"element face {face.count}" if line.split()[:2] == ["element", "face"] else line for line in header]
    out = ["\n".join([*header, "end_header", ""]).encode("ascii", "surrogateescape")]
    order = _order(form)
    for element in elements:
        out.append(element.raw)
        for row in element.rows:
            for values, (_, length, kind) in zip(row, element.properties, strict=True):
                whole = values if kind.startswith(("float", "double")) else values.astype(np.int64)
                if form == "ascii":
                    words = [repr(v) for v in whole.tolist()]
                    out.append(" ".join([*([str(len(words))] if length else []), *words, ""]).encode())
                    continue
                if length is not None:
                    out.append(struct.pack(order + _PLY_TYPES[length], len(values)))
                out.append(struct.pack(f"{order}{len(values)}{_PLY_TYPES[kind]}", *whole.tolist()))
            if form == "ascii":
                out.append(b"\n")
    return b"".join(out)
