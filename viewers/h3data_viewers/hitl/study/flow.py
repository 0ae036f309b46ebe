"""The order of what a participant does, as a state machine without any input or output.

What has happened is a list of rows (stage, data); the state follows from them, so that whatever is on the disk after a crash is
a state, too.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from h3data_viewers.hitl.study.design import Design, Place
from h3data_viewers.hitl.study.forms import checked_answers, forms_after

ACTIVE, COMPLETE, SCREENED_OUT, DROPPED, WITHDRAWN = "active", "complete", "screened_out", "dropped", "withdrawn"
STATUSES = (ACTIVE, COMPLETE, SCREENED_OUT, DROPPED, WITHDRAWN)
SMALL = "small_window"
"""Why a device is refused for now; also the row of its last report."""
PASSED = "success"
"""How an episode of the tutorial ends that has been passed."""


class NotNow(Exception):
    """The participant is somewhere else, or what they sent cannot be taken; the text is for them."""


@dataclass(frozen=True)
class Stage:
    """Something to do: ``device``, ``tutorial``, ``episode``, ``form`` or ``end``."""

    kind: str
    block: int = 0
    """From 1; 0: before the blocks; of forms at the end, one more than there are blocks."""
    trial: int = 0
    """Of an episode, within its block, from 1."""
    form: str = ""
    row: str = ""
    """`key`, where that does not follow from the above."""

    @property
    def key(self) -> str:
        """Its name in rows."""
        return self.row or "/".join(str(part) for part in (self.kind, self.block, self.trial or self.form) if part)


def stages_of(design: Design, place: Place) -> tuple[Stage, ...]:
    """Everything that a participant does after having consented."""
    stages = [Stage("device")]
    first = [form.id for form in forms_after(design, "consent")]
    stages += [Stage("form", form=form) for form in first]
    if not design.tutorial.skip:
        stages.append(Stage("tutorial"))
    for k, block in enumerate(place.blocks, 1):
        stages += [Stage("episode", k, trial) for trial in range(1, len(block.episodes) + 1)]
        stages += [Stage("form", k, form=form.id) for form in forms_after(design, "condition", block.condition)]
    for form in forms_after(design, "end"):
        row = f"form/end/{form.id}" if form.id in first else f"form/{form.id}"
        stages.append(Stage("form", len(place.blocks) + 1, form=form.id, row=row))
    return tuple(stages)


@dataclass
class Progress:
    """How far a participant has come."""

    design: Design
    place: Place
    rows: dict[str, dict[str, Any]] = field(default_factory=dict)
    """What has been done, by the key of its stage. Attempts at the tutorial have rows of their own (``tutorial/1``)."""
    status: str = ACTIVE
    reason: str = ""

    def __post_init__(self) -> None:
        self.stages = stages_of(self.design, self.place)

    @property
    def stage(self) -> Stage:
        """What comes next."""
        if self.status != ACTIVE:
            return Stage("end")
        return next((stage for stage in self.stages if stage.key not in self.rows), Stage("end"))

    @property
    def done(self) -> int:
        """Number of stages that are over."""
        return sum(stage.key in self.rows for stage in self.stages)

    @property
    def attempts(self) -> int:
        """Episodes of the tutorial that are over."""
        return sum(key.startswith("tutorial/") for key in self.rows)

    # --- what participants do -----------------------------------------------------------------------------------------
    def device(self, report: dict[str, Any]) -> dict[str, dict[str, Any]]:
        """Notes what is known about the device; where it is not good enough, that is the end. A window that is too small can
        be enlarged, and the check is made again, unless the report is the ``final`` one.

        Returns:
            The new rows.

        Raises:
            NotNow: it has been checked.
        """
        self._require("device")
        limits = self.design.device
        reasons = {
            "no_webgl": not report["webgl"],
            "slow_connection": report["ping_ms"] > limits.max_ping_ms,
            "slow_graphics": report["fps"] < limits.min_fps,
            "touch": report["touch"] and not limits.touch,
            SMALL: report["width"] < limits.min_width,
        }
        reason = next((name for name, holds in reasons.items() if holds), "")
        if reason == SMALL and not report.get("final"):
            return self._note({SMALL: report})
        if reason:
            self.end(SCREENED_OUT, reason)
        return self._note({"device": report})

    def answer(self, form_id: str, answers: dict[str, Any], block: int | None = None) -> dict[str, dict[str, Any]]:
        """Takes the answers of the form that is next.

        Args:
            form_id: The form that was filled in.
            answers: By item.
            block: The block that it was filled in for (`Stage.block`); None: the present one.

        Returns:
            The new rows.

        Raises:
            NotNow: another form is next, or an answer is missing or impossible.
        """
        stage = self._require("form")
        if stage.form != form_id or block not in (None, stage.block):
            raise NotNow("This form has been answered, or comes later. Reload the page.")
        taken, why = checked_answers(self.form, answers)
        if why:
            raise NotNow(why)
        return self._note({stage.key: {"form": form_id, "answers": taken}})

    def require_here(self, block: int | None, trial: int | None) -> None:
        """
        Raises:
            NotNow: a page names an episode (`Stage.block`, `Stage.trial`) that is not the present one.
        """
        stage = self.stage
        if block not in (None, stage.block) or (stage.block and trial not in (None, stage.trial)):
            raise NotNow("This page is of an earlier part of the study. Reload it.")

    @property
    def form(self) -> Any:
        """The form that is next."""
        stage = self.stage
        in_block = 0 < stage.block <= len(self.place.blocks)
        after = "condition" if in_block else "end" if stage.block else "consent"
        condition = self.place.blocks[stage.block - 1].condition if in_block else ""
        return next(form for form in forms_after(self.design, after, condition) if form.id == stage.form)

    # --- what games do ------------------------------------------------------------------------------------------------
    def over(self, key: str, result: dict[str, Any]) -> dict[str, dict[str, Any]]:
        """An episode is over.

        Args:
            key: Of the stage, or of the attempt at the tutorial.
            result: ``ended``, ``steps``, ``slipped`` and more.

        Returns:
            The new rows; none where it is known.
        """
        if key in self.rows:
            return {}
        rows = {key: result}
        if key.startswith("tutorial/"):
            self.rows |= rows
            if result["ended"] == PASSED:
                rows["tutorial"] = {"attempts": self.attempts}
            elif self.attempts >= self.design.tutorial.attempts and self.status == ACTIVE:
                self.end(SCREENED_OUT, "tutorial")
        if (
            result["ended"] == "closed" and self.status == ACTIVE
        ):  # only the participant closes an episode before its end
            self.end(WITHDRAWN, "left")
        return self._note(rows)

    def end(self, status: str, reason: str) -> None:
        """Ends the participation, once."""
        if self.status == ACTIVE:
            self.status, self.reason = status, reason

    def _require(self, kind: str) -> Stage:
        stage = self.stage
        if stage.kind != kind:
            raise NotNow("This has been done already, or comes later. Reload the page.")
        return stage

    def _note(self, rows: dict[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
        self.rows |= rows
        if self.status == ACTIVE and self.stage.kind == "end":
            self.status = COMPLETE
        return rows
