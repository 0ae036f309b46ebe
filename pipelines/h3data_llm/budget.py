"""Budget of tokens and calls of a whole job, shared by all of its processes and by jobs that name the same file.

The user writes a TOML file with ``tokens``, ``calls`` or both, and names it in the address of the model. Each answer adds a
line with its tokens to the file of the same name that ends in ``.spent``. Appending a short line is one write, so that no
process needs to wait for another.
"""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Annotated

import msgspec

from h3data.errors import InputError, JobStopError
from h3data_llm.endpoint import LanguageModelError

_AtLeastOne = Annotated[int, msgspec.Meta(ge=1)]


class BudgetSpentError(LanguageModelError, JobStopError):
    """Error of a job whose budget is used up; it sends no more requests and starts no more episodes."""


class _Limits(msgspec.Struct, forbid_unknown_fields=True):
    tokens: _AtLeastOne | None = None
    calls: _AtLeastOne | None = None


class JobBudget:
    """Limits of a job on tokens and calls, and the amounts that have been used."""

    def __init__(self, name: str) -> None:
        """Read the limits from a budget file.

        Args:
            name: Path of the file.

        Raises:
            InputError: there is no such file, or it does not hold limits.
        """
        self.file = Path(name)
        self.spent_file = self.file.with_name(self.file.name + ".spent")
        try:
            self.limits = msgspec.toml.decode(self.file.read_bytes(), type=_Limits)
        except OSError as fault:
            raise InputError(
                f"Cannot read the budget ({fault.strerror}): {name[:200]}. Hint: write a file with the line tokens = 200000.",
                code="H3-LLM-033",
            ) from None
        except (ValueError, msgspec.MsgspecError) as fault:
            why = " ".join(str(fault).replace("`", "").split())[:200]
            raise InputError(
                f"Expected tokens or calls of at least 1 in the budget {name[:200]}: {why}.", code="H3-LLM-034"
            ) from None
        if self.limits.tokens is None and self.limits.calls is None:
            raise InputError(f"The budget {name[:200]} has neither tokens nor calls.", code="H3-LLM-031")

    def spent(self) -> dict[str, int]:
        """Return the tokens and calls that have been used so far.

        Raises:
            InputError: the ``.spent`` file of the budget is malformed.
        """
        text = self.spent_file.read_text("ascii", "replace") if self.spent_file.is_file() else ""
        if re.fullmatch(r"(\d{1,18}\n)*", text) is None:
            raise InputError(
                f"Expected a number of tokens in each line. Remove this file to start again: {self.spent_file}",
                code="H3-LLM-032",
            )
        lines = text.split()
        return {"tokens": sum(map(int, lines)), "calls": len(lines)}

    def check(self) -> None:
        """Raise an error if nothing is left of the budget.

        Raises:
            BudgetSpentError: the tokens or calls are used up.
        """
        for name, used in self.spent().items():
            limit = getattr(self.limits, name)
            if limit is not None and used >= limit:
                raise BudgetSpentError(
                    f"The budget {self.file} is used up: {used:,} of {limit:,} {name}. Hint: raise it there, and go on with "
                    "--resume.",
                    code="H3-LLM-035",
                )

    def add(self, tokens: int) -> None:
        """Add the tokens of one answer."""
        with self.spent_file.open("ab", buffering=0) as file:
            os.write(file.fileno(), b"%d\n" % tokens)
