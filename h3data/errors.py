"""Tree of errors. Every error that the user can fix is an `H3DataError`: the command line prints it and exits with 2."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")


class H3DataError(Exception):
    """Base of all errors that h3data raises.

    Messages state the expected and the given value, and how to fix the error.

    Each kind of message has a code such as ``H3-SCENE-014``, which stays the same when its words change. `str` gives
    the sentence alone; a traceback shows the code in a line below it. `make error-codes` assigns the codes.
    """

    code: str = "H3-OTHER-000"
    """Code of the message. Errors without a specific code, such as those of plug-ins, have the code of their class."""

    def __init__(self, *args: object, code: str = "") -> None:
        super().__init__(*args)
        if code:
            self.code = code
            self.add_note(f"{code}: `h3data docs {code}` says more.")


class InputError(H3DataError):
    """Error of an argument or an input file that is not as expected."""


class FormatError(InputError):
    """Error about a file that is of another kind than expected, truncated, or written by a newer major version."""


class SceneError(H3DataError):
    """Error about a scene that cannot be used, or one of whose assets cannot be used."""


class MissingAssetError(SceneError):
    """Error about a file that a scene or recording refers to and that is not below any asset root."""


class MissingExtraError(H3DataError):
    """Error about an optional dependency that is not installed; the message names the command that installs it."""


class PluginError(H3DataError):
    """Error about an installed plug-in that cannot be used; the message names its package and entry point."""


class JobStopError(H3DataError):
    """Error that stops a whole job, for example when its budget is used up.

    Finished episodes are kept, and no other episode starts."""


class UntrustedNameError(InputError):
    """Error about a file that names code which is neither built in nor installed, and which the user has not trusted."""


def with_code(error: BaseException) -> str:
    """Return the text of an error, with its code at the end if it has one, for a shell, a log or the record of a job."""
    return f"{error} [{error.code}]" if isinstance(error, H3DataError) else str(error)


def did_you_mean(name: str, valid: Iterable[str]) -> str:
    """Return `` Did you mean 'x'?`` with the valid name closest to an unknown one; an empty string if none is close."""
    from difflib import get_close_matches

    by_lower = {other.lower(): other for other in valid}
    closest = get_close_matches(name.lower(), by_lower, n=1, cutoff=0.6)
    return f" Did you mean {by_lower[closest[0]]!r}?" if closest else ""


def suggest(name: str, valid: Iterable[str], *, lead: str = "Expected one of", more: str = "") -> str:
    """Return the end of an error message about an unknown name: the closest valid name, or else all valid names.

    Returns `` Did you mean 'x'?`` if a valid name is similar, otherwise `` Expected one of: a, b<more>.``, where
    ``lead`` replaces "Expected one of".
    """
    valid = list(valid)
    return did_you_mean(name, valid) or f" {lead}: {', '.join(valid) or 'none'}{more}."


def suggest_keywords(function: Callable[P, R]) -> Callable[P, R]:
    """Decorate a function so that the `TypeError` of an unknown keyword argument names the closest one, or all of them.

    Python 3.13 and later suggest the closest name, but do not list all names. The decorator is for functions without
    ``**`` arguments.
    """
    code = function.__code__
    keywords = code.co_varnames[code.co_posonlyargcount : code.co_argcount + code.co_kwonlyargcount]

    @functools.wraps(function)
    def checked(*args: P.args, **kwargs: P.kwargs) -> R:
        # before the call, whose own TypeError would not say what there is
        for name in kwargs:
            if name not in keywords:
                raise TypeError(f"{function.__name__}() has no argument {name!r}.{suggest(name, keywords)}")
        return function(*args, **kwargs)

    return checked
