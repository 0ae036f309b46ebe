"""Client of the Hugging Face Hub, with names of datasets and readable errors."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from h3data.errors import InputError, MissingExtraError

TYPE = "dataset"
_REPO = re.compile(r"[\w.-]+/[\w.-]+")
_TRANSPORT = ("httpx", "httpx2", "httpcore", "httpcore2", "requests", "urllib3")
_TOKEN_HINT = "Hint: make a token at https://huggingface.co/settings/tokens, then run `hf auth login` or set HF_TOKEN"


def checked_repo(repo: str) -> str:
    """Return the name of a dataset on the Hub as ``user/name``.

    Its web address and ``hf://datasets/user/name`` are accepted too.

    Raises:
        InputError: the argument has another form.
    """
    name = re.sub(r"^(https?://[^/]+/datasets/|hf://datasets/)", "", repo).strip("/")
    if not _REPO.fullmatch(name):
        raise InputError(f"Expected a dataset on the Hub as user/name, got {repo!r}.", code="H3-HUB-004")
    return name


def hub_api() -> Any:
    """Return the `huggingface_hub.HfApi` for the server that ``HF_ENDPOINT`` names.

    Raises:
        MissingExtraError: the extra ``hub`` is not installed.
    """
    try:
        import huggingface_hub
    except ImportError as error:
        raise MissingExtraError(
            'The Hugging Face Hub needs the extra "hub". Hint: pip install "h3data[hub]"', code="H3-HUB-005"
        ) from error
    return huggingface_hub.HfApi(endpoint=os.environ.get("HF_ENDPOINT") or None, library_name="h3data")


@contextmanager
def hub_errors(repo: str, *, to: str) -> Iterator[None]:
    """Turn errors of the Hub into an `InputError` with advice, and disable the Hub's progress bars.

    Args:
        repo: Name of the dataset.
        to: Direction of the transfer: ``"push"`` or ``"pull"``.
    """
    from huggingface_hub.utils import are_progress_bars_disabled, disable_progress_bars, enable_progress_bars

    were_off = are_progress_bars_disabled()
    disable_progress_bars()
    try:
        yield
    except Exception as error:
        of_file = isinstance(error, RuntimeError) and error.__cause__ is not None  # "Error while uploading ..."
        said = _explained(error.__cause__ if of_file else error, to)
        if said is None:
            raise
        endpoint = os.environ.get("HF_ENDPOINT") or "https://huggingface.co"
        raise InputError(f"{said}: {endpoint}/datasets/{repo}", code="H3-HUB-006") from None
    finally:
        if not were_off:
            enable_progress_bars()


def _explained(error: BaseException | None, to: str) -> str | None:
    """Explain an error of huggingface_hub and what to do; None for other errors."""
    from huggingface_hub import errors

    if isinstance(error, errors.LocalTokenNotFoundError):
        return f"The Hub asks who you are, and there is no token. {_TOKEN_HINT}"
    if isinstance(error, errors.RevisionNotFoundError):
        return "The dataset has no such revision (branch, tag or commit)"
    if isinstance(error, errors.GatedRepoError):
        return "Access to this dataset must be asked for on its page"
    if isinstance(error, errors.RepositoryNotFoundError):
        return f"There is no such dataset, or it is private and your token may not see it. {_TOKEN_HINT}"
    if isinstance(error, errors.OfflineModeIsEnabled):
        return f"HF_HUB_OFFLINE is set, so nothing is asked of the Hub. Unset it to {to}"
    if isinstance(error, errors.HfHubHTTPError):
        status = getattr(error.response, "status_code", None)
        if status == 401:
            return f"The Hub does not know this token, or there is none. {_TOKEN_HINT}"
        if status == 403:
            right = "write to" if to == "push" else "read"
            return f"This token may not {right} the dataset. Expected one of the owner or a member with that right"
        return f"The Hub refused ({' '.join(str(error.server_message or error).split())})"
    if isinstance(error, ConnectionError) or type(error).__module__.partition(".")[0] in _TRANSPORT:
        text = " ".join(str(error).split()) or type(error).__name__
        return f"The Hub cannot be reached ({text}). The same command goes on where this one stopped"
    return None
