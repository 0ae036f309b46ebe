"""Order of a participant's stages, as a state machine without input or output.

Completed stages are rows (stage, data), from which the state follows. The rows on the disk after a crash are therefore
a valid state.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from h3data_studies.design import Design, Form, Place
from h3data_studies.forms import checked_answers, forms_after, wrong_items

ACTIVE, COMPLETE, SCREENED_OUT, DROPPED, WITHDRAWN = "active", "complete", "screened_out", "dropped", "withdrawn"
STATUSES = (ACTIVE, COMPLETE, SCREENED_OUT, DROPPED, WITHDRAWN)
SMALL = "small_window"
"""Reason for refusing a device for now, and name of the row with its last report."""
CHECK, FAILED = "check", "failed_check"
"""Name of rows with answers that did not pass a form's checks, and reason for screening out after the last attempt."""
PARTED, UNPAIRED = "partner_left", "no_partner"
"""Reasons for the end of a participation: the partner of the pair has left, or none has come."""
PASSED = "success"
"""Reason of ending of a tutorial episode that was passed."""


class NotNow(Exception):
    """Error for a request that does not fit the participant's stage or is invalid; the text is for the participant."""


@dataclass(frozen=True)
class Stage:
    """Stage of a study: ``device``, ``tutorial``, ``episode``, ``form`` or ``end``."""

    kind: str
    block: int = 0
    """Number of the block from 1; 0 before the blocks, and the number of blocks plus one for forms at the end."""
    trial: int = 0
    """Number of the episode within its block from 1; a form after an episode has the number of this episode."""
    form: str = ""
    after: str = ""
    """Place of the form in the study (`Form.after`); empty for other stages."""
    row: str = ""
    """Value of `key` if it does not follow from the other fields."""

    @property
    def key(self) -> str:
        """Name of the stage in the rows of a participant."""
        return self.row or "/".join(str(part) for part in (self.kind, self.block, self.trial or self.form) if part)


def stages_of(design: Design, place: Place) -> tuple[Stage, ...]:
    """Return all stages of a participant after consent."""
    stages = [Stage("device")]
    first = [form.id for form in forms_after(design, "consent")]
    stages += [Stage("form", form=form, after="consent") for form in first]
    if not design.tutorial.skip:
        stages.append(Stage("tutorial"))
    stages += [Stage("form", form=form.id, after="tutorial") for form in forms_after(design, "tutorial")]
    for k, block in enumerate(place.blocks, 1):
        asked = [form.id for form in forms_after(design, "trial", block.condition)]
        for trial in range(1, len(block.episodes) + 1):
            stages.append(Stage("episode", k, trial))
            stages += [Stage("form", k, trial, form, "trial", f"form/{k}/{trial}/{form}") for form in asked]
        forms = forms_after(design, "condition", block.condition)
        stages += [Stage("form", k, form=form.id, after="condition") for form in forms]
    for form in forms_after(design, "end"):
        row = f"form/end/{form.id}" if form.id in first else f"form/{form.id}"
        stages.append(Stage("form", len(place.blocks) + 1, form=form.id, after="end", row=row))
    return tuple(stages)


@dataclass
class Progress:
    """Progress of a participant through the stages of a study."""

    design: Design
    place: Place
    rows: dict[str, dict[str, Any]] = field(default_factory=dict)
    """Completed stages by key. Each attempt at the tutorial has its own row (``tutorial/1``)."""
    status: str = ACTIVE
    reason: str = ""

    def __post_init__(self) -> None:
        self.stages = stages_of(self.design, self.place)

    @property
    def stage(self) -> Stage:
        """Return the next stage."""
        if self.status != ACTIVE:
            return Stage("end")
        return next((stage for stage in self.stages if stage.key not in self.rows), Stage("end"))

    @property
    def done(self) -> int:
        """Number of completed stages."""
        return sum(stage.key in self.rows for stage in self.stages)

    @property
    def attempts(self) -> int:
        """Number of completed episodes of the tutorial."""
        return sum(key.startswith("tutorial/") for key in self.rows)

    def is_shared(self, row: str) -> bool:
        """Return whether a row belongs to an episode that two participants play together."""
        kind, *numbers = row.split("/")
        return kind == "episode" and self.design.condition(self.place.blocks[int(numbers[0]) - 1].condition).is_shared

    @property
    def has_met(self) -> bool:
        """Return whether the participant has played together with another one."""
        return any(map(self.is_shared, self.rows))

    # --- what participants do -----------------------------------------------------------------------------------------
    def device(self, report: dict[str, Any]) -> dict[str, dict[str, Any]]:
        """Store a report about the participant's device, and end the participation if the device is not suitable.

        A window that is too small can be enlarged and is checked again, unless the report is the ``final`` one.

        Returns:
            The new rows.

        Raises:
            NotNow: the device has been checked already.
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

    def answer(
        self, form_id: str, answers: dict[str, Any], block: int | None = None, trial: int | None = None
    ) -> dict[str, dict[str, Any]]:
        """Store the answers to the participant's next form.

        A form whose checks are not passed is asked again; after the last attempt the answers are stored, and the
        participation may end.

        Args:
            form_id: form that was filled in.
            answers: answers by item.
            block: block for which it was filled in (`Stage.block`); None is the current one.
            trial: episode of the block (`Stage.trial`); None is the current one.

        Returns:
            The new rows.

        Raises:
            NotNow: another form is next, or an answer is missing or invalid.
        """
        stage = self._require("form")
        if stage.form != form_id or block not in (None, stage.block) or trial not in (None, stage.trial):
            raise NotNow("This form has been answered, or comes later. Reload the page.")
        taken, why = checked_answers(self.form, answers)
        if why:
            raise NotNow(why)
        filled: dict[str, Any] = {"form": form_id, "answers": taken}
        if self.form.has_checks:
            filled |= {"wrong": wrong_items(self.form, taken), "attempt": self.tries + 1}
            if filled["wrong"] and filled["attempt"] < self.form.attempts:
                return self._note({f"{CHECK}/{stage.key}/{filled['attempt']}": filled})
            if filled["wrong"] and self.form.fail == "screen_out":
                self.end(SCREENED_OUT, FAILED)
        return self._note({stage.key: filled})

    @property
    def tries(self) -> int:
        """Return how often the next form was answered without passing its checks."""
        return sum(key.startswith(f"{CHECK}/{self.stage.key}/") for key in self.rows)

    def require_here(self, block: int | None, trial: int | None) -> None:
        """Check that a page refers to the participant's current episode.

        Raises:
            NotNow: the page refers to another episode (`Stage.block`, `Stage.trial`).
        """
        stage = self.stage
        if block not in (None, stage.block) or (stage.block and trial not in (None, stage.trial)):
            raise NotNow("This page is of an earlier part of the study. Reload it.")

    @property
    def form(self) -> Form:
        """Form that the participant has to fill in next."""
        stage = self.stage
        return self.form_of(stage)[0]

    def form_of(self, stage: Stage) -> tuple[Form, str]:
        """Return the form of a stage, and the name of its condition (empty if it is about none)."""
        condition = self.place.blocks[stage.block - 1].condition if stage.after in ("trial", "condition") else ""
        forms = forms_after(self.design, stage.after, condition)
        return next(form for form in forms if form.id == stage.form), condition

    # --- what games do ------------------------------------------------------------------------------------------------
    def over(self, key: str, result: dict[str, Any]) -> dict[str, dict[str, Any]]:
        """Handle the end of an episode.

        Args:
            key: Key of the stage, or of the attempt at the tutorial.
            result: ``ended``, ``steps``, ``slipped`` and more.

        Returns:
            The new rows; empty if the end is already stored.
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
        """End the participation; do nothing if it has already ended."""
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
