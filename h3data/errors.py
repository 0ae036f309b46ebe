"""The one error tree. Whatever is the user's to mend is an `H3DataError`: the command line prints it and exits with 2."""

from __future__ import annotations


class H3DataError(Exception):
    """Base of every error that h3data raises on purpose. The message says what was expected, what came, what to do."""


class InputError(H3DataError):
    """An argument or an input file is not what it should be."""


class FormatError(InputError):
    """A file is of another kind than expected, truncated, or written by a newer major version."""


class SceneError(H3DataError):
    """A scene or one of its assets cannot be used."""


class MissingAssetError(SceneError):
    """A file that a scene or recording refers to was not found below the asset roots."""


class MissingExtraError(H3DataError):
    """An optional dependency is not installed; the message names the command that installs it."""
