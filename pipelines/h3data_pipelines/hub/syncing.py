"""Command ``h3data sync``, which copies a dataset to another folder or object store, or updates such a copy."""

from __future__ import annotations

import hashlib
import shutil
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Annotated, Any

import pyarrow.fs as pafs
import tyro

from h3data.commands.arguments import result_of
from h3data.commands.command import DryRunFlag, JsonFlag, Outcome, keeping
from h3data.commands.options import command_of
from h3data.errors import FormatError, InputError, suggest_keywords
from h3data.files import part_file, size_text
from h3data.progress import progress
from h3data.recording.parquet.files import is_dataset, write_atomic
from h3data.recording.storage import AnyPath, RemotePath, allowed, open_binary, place
from h3data.terminal import counted
from h3data_pipelines.hub.checksums import file_sha256

if TYPE_CHECKING:
    from h3data.commands.arguments import FilePath

_THREADS = 8
_BLOCK = 1 << 20
_TABLES = 1
"""`_rank` of the tables that commit episodes."""
_INFO = "meta/info.json"
_WRITER = "h3/writer"


@suggest_keywords
def sync(source: FilePath, target: FilePath, *, quick: bool = False, force: bool = False) -> Path | RemotePath:
    """Copy a dataset to another folder or object store, or update such a copy, with the options of ``h3data sync``.

    Returns:
        The location of the copy.

    Raises:
        InputError: the source is no dataset, or the target holds anything but a copy of it.
        FormatError: a copied file differs from its source.
    """
    return result_of(Sync, locals())


@command_of(sync)
class Sync:
    """Copy a dataset between folders and object stores, or only the files that a copy lacks.

    Every file is compared by SHA-256, both the files that exist already and each new copy. The tables that list
    episodes are copied last, so the copy holds complete episodes at any time, and after an interruption the same
    command continues. The source may still be growing.

    Examples:
        h3data sync ds/ s3://bucket/ds
        h3data sync s3://bucket/ds /mnt/disk/ds
        h3data sync ds/ s3://bucket/ds --dry-run
        h3data sync s3://bucket/ds gs://other/ds --quick
    """

    source: tyro.conf.Positional[Path]
    """Dataset, as a folder or URI."""
    target: tyro.conf.Positional[Path]
    """Folder or URI of the copy."""
    quick: Annotated[bool, tyro.conf.arg(help="Take files of the same size as equal, without reading them.")]
    dry_run: DryRunFlag = False
    force: Annotated[
        bool,
        tyro.conf.arg(
            help="Make the target equal even if it holds another dataset: files that the source lacks are deleted."
        ),
    ]
    json: JsonFlag = False

    def run(self) -> Outcome:
        """Copy the files that are missing in the target and return their number."""
        source, target = place(self.source), place(self.target)
        if not is_dataset(source):
            raise InputError(f"Expected a dataset to copy, there is none: {source}", code="H3-HUB-013")
        if _same_place(source, target):
            raise InputError(f"The source and the target are the same: {source}", code="H3-HUB-014")
        if isinstance(target, Path) and target.exists() and not target.is_dir():
            raise InputError(f"Expected a folder for the copy, this is a file: {target}", code="H3-HUB-015")
        info = _read(source / _INFO)  # before the list: its count must not be ahead of the tables
        sizes = {name: size for name, size in sizes_below(source).items() if _belongs(name)}
        there = {name: size for name, size in sizes_below(target).items() if _belongs(name)}
        if not self.force:
            _require_a_copy(source, target, there, sizes)
        changed = self._to_copy(source, target, sizes, there)
        surplus = sorted(there.keys() - sizes.keys())
        data: dict[str, Any] = {
            "source": str(source),
            "target": str(target),
            "files": len(sizes),
            "copied": changed,
            "bytes": sum(sizes[name] for name in changed),
            "deleted": surplus,
        }
        amount = f"{counted(len(changed), 'file')} of {len(sizes)}, {size_text(data['bytes'])}"
        gone = f", {counted(len(surplus), 'file')} deleted" if surplus else ""
        if self.dry_run:
            return Outcome(text=f"would copy {amount}{gone.replace('deleted', 'to delete')}: {target}", data=data)
        replaced = [name for name in changed if name in there] if self.force else []
        _delete(target, [*surplus, *replaced])
        _copy(source, target, changed, info)
        if not changed and not surplus:
            return Outcome(text=f"nothing to copy, {counted(len(sizes), 'file')}: {target}", data=data, result=target)
        return Outcome(text=f"copied {amount}{gone}: {target}", data=data, result=target)

    def _to_copy(self, source: AnyPath, target: AnyPath, sizes: dict[str, int], there: dict[str, int]) -> list[str]:
        """Return names of files that the target lacks or has otherwise."""
        alike = [name for name in sizes if there.get(name) == sizes[name]]
        changed = {name for name in sizes if there.get(name) != sizes[name]}
        if not self.quick:

            def differs(name: str) -> bool:
                return file_sha256(source / name) != file_sha256(target / name)

            with ThreadPoolExecutor(_THREADS) as pool:
                found = progress(pool.map(differs, alike), total=len(alike), desc="compare", unit="file", leave=False)
                changed |= {name for name, other in zip(alike, found, strict=True) if other}
        return sorted(changed, key=lambda name: (_rank(name), name))


def _delete(target: AnyPath, names: list[str]) -> None:
    """Delete files, the tables that list episodes before the data."""
    for name in sorted(names, key=_rank, reverse=True):
        (target / name).unlink()


def _copy(source: AnyPath, target: AnyPath, names: list[str], info: bytes | None) -> None:
    """Copy files; ``info`` is info.json as it was before the source was listed."""
    kept = "whole files of the copy are kept: the same command goes on"
    with keeping(lambda: kept), progress(total=len(names), desc="copy", unit="file") as bar:
        for rank in range(4):
            some = [name for name in names if _rank(name) == rank]
            threads = 1 if rank == _TABLES else _THREADS  # in order: a later table counts from an earlier one
            with ThreadPoolExecutor(threads) as pool:
                under_way = [pool.submit(_copy_file, source, target, name, info) for name in some]
                try:
                    for each in as_completed(under_way):
                        each.result()
                        bar.update()
                except BaseException:
                    pool.shutdown(cancel_futures=True)
                    raise


def _copy_file(source: AnyPath, target: AnyPath, name: str, info: bytes | None) -> None:
    """Copy a file and read the copy again.

    Raises:
        FormatError: it arrived otherwise than it was sent.
    """
    at = target / name
    if isinstance(at, Path):
        at.parent.mkdir(parents=True, exist_ok=True)
    if _rank(name) > _TABLES:  # a writer may replace these meanwhile
        content = info if name == _INFO and info is not None else (source / name).read_bytes()
        write_atomic(at, content)
        _require_digest(at, hashlib.sha256(content).hexdigest())
        return
    digest = file_sha256(source / name)
    with open_binary(source / name) as read:
        if isinstance(at, RemotePath):
            at.put(read)
        else:
            with part_file(at) as part, part.open("wb") as write:
                shutil.copyfileobj(read, write, _BLOCK)
    _require_digest(at, digest)


def _require_digest(path: AnyPath, digest: str) -> None:
    if file_sha256(path) != digest:
        raise FormatError(
            f"The copy differs from the original; it may have changed meanwhile. Try again: {path}", code="H3-HUB-010"
        )


def _read(path: AnyPath) -> bytes | None:
    return path.read_bytes() if path.is_file() else None


def _belongs(name: str) -> bool:
    """Return whether a file is part of a dataset; unfinished files of a writer and the writer's mark are not."""
    parts = PurePosixPath(name).parts
    return name != _WRITER and not name.endswith(".part") and not any(part.startswith(".") for part in parts)


def _rank(name: str) -> int:
    """Return the order of copying a file: data, tables that commit episodes, their counts, info.json."""
    if name == _INFO:
        return 3
    if name.startswith("meta/episodes/"):
        return _TABLES
    return 2 if name.startswith("meta/") else 0


def _same_place(source: AnyPath, target: AnyPath) -> bool:
    if isinstance(source, Path) and isinstance(target, Path):
        return source.resolve() == target.resolve()
    return source == target


def _require_a_copy(source: AnyPath, target: AnyPath, there: dict[str, int], sizes: dict[str, int]) -> None:
    """Refuse a target that is anything but an earlier copy of the source.

    Raises:
        InputError: it holds other files, or other episodes.
    """
    if not there:
        return
    if others := sorted(there.keys() - sizes.keys()):
        raise InputError(
            f"The target holds {counted(len(others), 'file')} that the source lacks, the first: {others[0]}. --force deletes "
            f"them and makes the target equal: {target}",
            code="H3-HUB-011",
        )
    if not any(name.startswith("meta/episodes/") for name in there):
        return
    from h3data.recording import Dataset

    try:
        mine, theirs = ([row["uid"] for row in Dataset(root).rows] for root in (source, target))
    except FormatError as error:
        raise InputError(
            f"The target cannot be read as a dataset; --force copies over it ({error})", code="H3-HUB-016"
        ) from None
    if mine[: len(theirs)] != theirs:
        raise InputError(
            f"The target holds other episodes than the source; --force replaces them: {target}", code="H3-HUB-012"
        )


def sizes_below(folder: AnyPath) -> dict[str, int]:
    """Return the sizes [bytes] of all files below a folder by relative path, sorted.

    The result is empty if the folder does not exist.
    """
    if isinstance(folder, Path):
        paths = sorted(path for path in folder.rglob("*") if path.is_file())
        return {path.relative_to(folder).as_posix(): path.stat().st_size for path in paths}
    selector = pafs.FileSelector(folder.key, recursive=True, allow_not_found=True)
    with allowed("list", folder):
        found = folder.filesystem.get_file_info(selector)
    sizes = {info.path[len(folder.key) :].strip("/"): info.size for info in found if info.type == pafs.FileType.File}
    return dict(sorted(sizes.items()))
