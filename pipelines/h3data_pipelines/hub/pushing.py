"""Command ``h3data push``, which uploads a dataset to the Hugging Face Hub."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro

from h3data.commands.arguments import result_of
from h3data.commands.command import DryRunFlag, JsonFlag, Outcome, keeping
from h3data.commands.options import command_of
from h3data.errors import InputError, suggest_keywords
from h3data.files import size_text
from h3data.progress import progress
from h3data.recording.storage import local
from h3data.terminal import counted
from h3data_pipelines.hub.card import CARD, PICTURE, write_card
from h3data_pipelines.hub.checksums import FILE as CHECKSUMS
from h3data_pipelines.hub.checksums import PARTS, checksums_of, files_of, to_json
from h3data_pipelines.hub.client import TYPE, checked_repo, hub_api, hub_errors
from h3data_pipelines.hub.lerobot_env import write_env

if TYPE_CHECKING:
    from h3data.commands.arguments import FilePath

VERSION_TAG = "v3.0"
"""Tag of the revision that LeRobot loads, which is the version of LeRobot's format."""
_BATCH = 16
"""Number of files uploaded between two updates of the progress bar."""


@suggest_keywords
def push(dataset: FilePath, repo: str, *, private: bool = False, message: str = "", env: FilePath | None = None) -> str:
    """Upload a dataset to the Hugging Face Hub, with the options of ``h3data push``.

    Returns:
        The web address of the dataset.

    Raises:
        MissingExtraError: the extra ``hub`` is not installed.
        InputError: there is no token, the token has no right to write, or the Hub cannot be reached.
    """
    return result_of(Push, locals())


@command_of(push)
class Push:
    """Upload a dataset to the Hugging Face Hub.

    Requires pip install "h3data[hub]". All files appear in one commit. After an interruption the same command
    continues, and files that are on the Hub already are not uploaded again. The token comes from `hf auth login` or
    HF_TOKEN, and the server from HF_ENDPOINT.

    Examples:
        h3data push ds/ user/name
        h3data push ds/ user/name --private
        h3data push lerobot/ user/name --env env/ --dry-run
    """

    dataset: tyro.conf.Positional[Path]
    """Folder of the dataset."""
    repo: tyro.conf.Positional[str]
    """Name on the Hub, as user/name; created if it does not exist."""
    private: bool
    """Create the dataset as private; an existing dataset keeps its visibility."""
    message: str
    """Message of the commit."""
    env: Path | None
    """Folder for env.py, requirements.txt and README.md, which provide the environment of a dataset that was exported
    to LeRobot. `hf upload user/name FOLDER .` uploads them to a model repository of the same name.
    """
    dry_run: DryRunFlag = False
    json: JsonFlag = False

    def run(self) -> Outcome:
        """Upload the dataset, with a card if it has none, and return its address."""
        from h3data.recording import Dataset

        dataset, repo = Dataset(local(self.dataset)), checked_repo(self.repo)
        root = Path(str(dataset.root))
        if not len(dataset):
            raise InputError(f"The dataset has no episodes: {root}", code="H3-HUB-009")
        written = [] if self.env is None else write_env(dataset, self.env, repo=repo)
        made = [f"\nwrote {path}" for path in written]
        if written:
            made.append(f"\nTo publish the environment: hf upload {repo} {self.env} .")
        if self.dry_run:
            names = files_of(root)
            text = (
                f"Would push {counted(len(dataset), 'episode')}, {counted(len(names), 'file')} to {repo}{''.join(made)}"
            )
            plan = {"repo": repo, "episodes": len(dataset), "files": len(names), "env": [str(path) for path in written]}
            return Outcome(text=text, data={"plan": plan}, result="")
        api = hub_api()
        if not (root / CARD).exists():
            write_card(dataset, repo=repo)
        names = files_of(root)
        checksums = to_json(checksums_of(root, names))
        names += [name for name in (CARD, PICTURE) if (root / name).is_file()]
        size = sum((root / name).stat().st_size for name in names)
        kept = f"what was uploaded to {repo} is not uploaded again by the same command"
        with hub_errors(repo, to="push"), keeping(lambda: kept):
            if not api.repo_exists(repo, repo_type=TYPE):
                api.create_repo(repo, repo_type=TYPE, private=self.private or None, exist_ok=True)
            additions = _uploaded(api, repo, root, names, checksums)
            message = self.message or f"{counted(len(dataset), 'episode')} by h3data"
            commit = api.create_commit(
                repo,
                [*additions, *_deletions(api, repo, {*names, CHECKSUMS})],
                commit_message=message,
                repo_type=TYPE,
            )
            _tag(api, repo)
        url = f"{api.endpoint}/datasets/{repo}"
        text = f"pushed {counted(len(dataset), 'episode')}, {counted(len(names), 'file')}, {size_text(size)}: {url}"
        text += "".join(made)
        data = {
            "repo": repo,
            "url": url,
            "episodes": len(dataset),
            "files": len(names),
            "bytes": size,
            "commit": commit.oid,
            "env": [str(path) for path in written],
        }
        return Outcome(text=text, data=data, result=url)


def _uploaded(api: Any, repo: str, root: Path, names: Sequence[str], checksums: bytes) -> list[Any]:
    """Return the operations of a commit whose large files are on the server already.

    `HfApi.upload_folder` would do as much in one call, and `upload_large_folder` in many commits, of which an interruption
    leaves some: a dataset without its last shards looks whole to LeRobot.
    """
    from huggingface_hub import CommitOperationAdd

    additions = [CommitOperationAdd(path_in_repo=name, path_or_fileobj=str(root / name)) for name in names]
    with progress(total=len(additions), desc="upload", unit="file") as bar:
        for k in range(0, len(additions), _BATCH):
            batch = additions[k : k + _BATCH]
            api.preupload_lfs_files(repo, batch, repo_type=TYPE, free_memory=False)
            bar.update(len(batch))
    return [*additions, CommitOperationAdd(path_in_repo=CHECKSUMS, path_or_fileobj=checksums)]


def _deletions(api: Any, repo: str, names: set[str]) -> list[Any]:
    """Return the operations that delete files of an earlier version, as LeRobot reads every data file that exists."""
    from huggingface_hub import CommitOperationDelete

    present = api.list_repo_files(repo, repo_type=TYPE)
    old = [name for name in present if name.partition("/")[0] in PARTS and name not in names]
    return [CommitOperationDelete(path_in_repo=name) for name in old]


def _tag(api: Any, repo: str) -> None:
    """Move the tag by which LeRobot finds datasets of its version to the latest commit."""
    from huggingface_hub.errors import HfHubHTTPError

    with suppress(HfHubHTTPError):  # there was none
        api.delete_tag(repo, tag=VERSION_TAG, repo_type=TYPE)
    api.create_tag(repo, tag=VERSION_TAG, repo_type=TYPE, exist_ok=True)
