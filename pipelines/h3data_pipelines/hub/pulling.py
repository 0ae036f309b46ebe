"""Command ``h3data pull``, which downloads a dataset from the Hugging Face Hub."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from h3data.commands.arguments import result_of
from h3data.commands.command import ForceFlag, JsonFlag, Outcome, claim_folder, keeping
from h3data.commands.options import command_of
from h3data.errors import FormatError, InputError, suggest_keywords
from h3data.files import size_text
from h3data.progress import progress
from h3data.recording.storage import local
from h3data.terminal import counted
from h3data_pipelines.dataset_folders import remove_dataset
from h3data_pipelines.hub.checksums import PARTS, require_checksums
from h3data_pipelines.hub.client import TYPE, checked_repo, hub_api, hub_errors

if TYPE_CHECKING:
    from h3data.commands.arguments import FilePath

_THREADS = 4
_BESIDE = ("README.md", "card.jpg")


@suggest_keywords
def pull(repo: str, out: FilePath, *, revision: str = "main", force: bool = False) -> Path:
    """Download a dataset from the Hugging Face Hub, with the options of ``h3data pull``.

    Returns:
        The dataset's folder.

    Raises:
        MissingExtraError: the extra ``hub`` is not installed.
        InputError: there is no such dataset, or the Hub cannot be reached.
        FormatError: the downloaded files differ from those that were pushed.
    """
    return result_of(Pull, locals())


@command_of(pull)
class Pull:
    """Download a dataset from the Hugging Face Hub.

    Requires pip install "h3data[hub]". The dataset appears under its name when it is complete and its checksums are
    correct. Until then it is DIR.part, and after an interruption the same command continues. Private datasets need a
    token, from `hf auth login` or HF_TOKEN.

    Examples:
        h3data pull user/name -o ds/
        h3data pull user/name --revision v3.0 -o ds/
    """

    repo: tyro.conf.Positional[str]
    """Name on the Hub, as user/name."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Folder to which the dataset is downloaded."""
    revision: str
    """Branch, tag or commit."""
    force: ForceFlag
    json: JsonFlag = False

    def run(self) -> Outcome:
        """Download the dataset and return its number of episodes and its size."""
        from h3data.recording import Dataset

        repo, out, api = checked_repo(self.repo), local(self.out), hub_api()
        part = out.with_name(f"{out.name}.part")
        claim_folder(out, force=self.force)
        with hub_errors(repo, to="pull"):
            commit = api.repo_info(repo, repo_type=TYPE, revision=self.revision).sha
            listed = api.list_repo_tree(repo, repo_type=TYPE, revision=commit, recursive=True)
            sizes = {entry.path: entry.size for entry in listed if hasattr(entry, "size")}
        names = [name for name in sizes if name.partition("/")[0] in PARTS or name in _BESIDE]
        if "h3/schema.json" not in names:
            raise InputError(
                f"Expected a dataset that h3data wrote, this one has no h3/schema.json: {api.endpoint}/datasets/{repo}",
                code="H3-HUB-007",
            )
        free = shutil.disk_usage(out.parent).free
        if (size := sum(sizes[name] for name in names)) > free:
            raise InputError(
                f"The dataset takes {size_text(size)}, the disk has {size_text(free)} left: {out}", code="H3-HUB-008"
            )
        with keeping(lambda: f"what is downloaded is in {part}: the same command goes on"):
            with hub_errors(repo, to="pull"):
                _download(api, repo, commit, names, part)
            try:
                checked = require_checksums(part)
                episodes = len(Dataset(part)) if checked else _read_all(Dataset(part))
            except FormatError:
                shutil.rmtree(part)  # the next try shall not begin with it
                raise
        shutil.rmtree(part / ".cache", ignore_errors=True)
        if self.force:
            remove_dataset(out)
        part.replace(out)
        how = f"{checked} checksums are right" if checked else "every episode was read"
        text = f"pulled {counted(episodes, 'episode')}, {counted(len(names), 'file')}, {size_text(size)}, {how}: {out}"
        data = {
            "repo": repo,
            "commit": commit,
            "dataset": str(out),
            "episodes": episodes,
            "files": len(names),
            "bytes": size,
        }
        return Outcome(text=text, data={**data, "checksums": checked}, result=out)


def _download(api: Any, repo: str, commit: str, names: Sequence[str], folder: Path) -> None:
    """Download files into ``folder``, those that are there already excepted; files of another version are removed."""
    for path in folder.rglob("*") if folder.exists() else ():
        name = path.relative_to(folder).as_posix()
        if path.is_file() and not name.startswith(".cache/") and name not in names:
            path.unlink()

    def fetch(name: str) -> None:
        api.hf_hub_download(repo, name, repo_type=TYPE, revision=commit, local_dir=folder)

    with ThreadPoolExecutor(_THREADS) as pool:
        futures = [pool.submit(fetch, name) for name in names]
        try:
            for future in progress(as_completed(futures), total=len(names), desc="download", unit="file"):
                future.result()
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


def _read_all(dataset: Any) -> int:
    """Read every episode of a dataset that came without checksums: its own are checked on the way."""
    for _ in progress(dataset, total=len(dataset), desc="check", unit="episode"):
        pass
    return len(dataset)
