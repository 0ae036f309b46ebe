"""Record types of a study file, which the command and the server share."""

from __future__ import annotations

from datetime import date
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from h3data_play.plan import PlayPlan

Name = Annotated[str, Meta(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,39}$")]
Text = str | dict[str, str]
"""Text for participants: one for all languages, or one by language."""
Minutes = Annotated[float, Meta(gt=0, le=10_000)]
Count = Annotated[int, Meta(ge=1, le=1000)]
Role = Literal["person", "robot"]


class Record(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Base of the record types; unknown fields in a file are errors."""


class Condition(Record, frozen=True):
    """Condition of a study, under which a block of episodes is played."""

    name: Name
    app: str = "rearrange"
    play_as: Role | Annotated[list[Role], Meta(min_length=1, max_length=2)] = "person"
    """Role of a participant, or a list of two roles if two participants play together in one home."""
    partner: str | None = None
    """Policy of all agents without a player (a name, ``weights:FILE``, or ``solo``); None selects the task's default."""
    rules: dict[str, Any] = {}
    """Rules of the task that replace those of the app."""
    names: bool = False
    """True if participants see a name over the head of every other agent."""
    text: Text = ""
    """Text that participants read before the first episode. It should not reveal the condition."""

    @property
    def is_solo(self) -> bool:
        """Return whether people play alone, or among themselves."""
        return self.partner == "solo" or (self.partner is None and self.seats.count("person") > 1)

    @property
    def seats(self) -> tuple[Role, ...]:
        """Roles of the participants who play together."""
        return (self.play_as,) if isinstance(self.play_as, str) else tuple(self.play_as)

    @property
    def is_shared(self) -> bool:
        """Return whether two participants play together."""
        return len(self.seats) > 1


class Consent(Record, frozen=True):
    """Text and questions to which participants consent before taking part."""

    version: Name
    text: Text = ""
    file: str = ""
    """Name of a text file next to the study file, which is used in place of ``text``."""


class Device(Record, frozen=True):
    """Requirements for the computers and connections of participants."""

    max_ping_ms: Annotated[float, Meta(gt=0)] = 250.0
    """Largest median round trip [ms]."""
    min_width: Annotated[int, Meta(ge=0)] = 640
    """Least width of the window [px]."""
    min_fps: Annotated[float, Meta(ge=0)] = 15.0
    """Least frame rate of a blank scene [1/s]."""
    touch: bool = True
    """True if phones and tablets may take part."""


class Tutorial(Record, frozen=True):
    """Practice that participants must pass before episodes count."""

    app: str = "tutorial"
    rules: dict[str, Any] = {}
    attempts: Count = 5
    """Number of attempts after which a participant who has not passed is screened out."""
    skip: bool = False
    text: Text = ""


class DropOut(Record, frozen=True):
    """Rule by which a participant counts as gone, so that their place becomes free for another person."""

    idle_minutes: Minutes = 20.0
    """Time without a key, click or answer after which a participant has dropped out [minutes]; pauses count."""
    total_minutes: Minutes = 240.0
    """Time limit from consent to the end [minutes]."""
    wait_minutes: Minutes = 20.0
    """Time for which a participant waits for the partner of their pair [minutes]."""
    max_slip: Annotated[float, Meta(ge=0, le=1)] = 0.01
    """Largest share of late steps in an episode; the report excludes episodes with more."""


class Recruiting(Record, frozen=True):
    """Recruiting of participants, and the code that they return to the platform."""

    require_id: bool = False
    """True if only people whose link has a ``PROLIFIC_PID`` may take part."""
    id_pattern: str | dict[str, str] | None = None
    """Regular expression for a whole ``PROLIFIC_PID``, or one for each id by its name; None: 24 hexadecimal digits."""
    completion_code: str = ""
    completion_url: str = ""
    """Address that is opened at the end of the participation; ``{code}`` stands for the completion code."""
    screen_out_code: str = ""
    screen_out_url: str = ""
    unique_codes: bool = False
    """True if each participant who finishes gets a personal completion code (``h3data study pay`` lists them)."""


class Exclude(Record, frozen=True):
    """Exclusion rule for participants or episodes in the report, which is fixed before the study starts."""

    name: Name
    what: str
    """Name of the measure that the rule tests (`h3data_studies.exclusions`)."""
    of: Literal["participant", "trial"] = "participant"
    above: float | None = None
    below: float | None = None
    """Limits of the measure: participants or episodes above ``above`` or below ``below`` are excluded; None for no limit."""


class Bonus(Record, frozen=True):
    """Payment in addition to the fixed reward, for participants who finish."""

    base: Annotated[float, Meta(ge=0)] = 0.0
    per_success: Annotated[float, Meta(ge=0)] = 0.0
    """Bonus for each episode that ended with success."""
    most: Annotated[float, Meta(ge=0)] | None = None


class Item(Record, frozen=True):
    """Question of a form, with its kind of answer."""

    id: Name
    text: Text
    kind: Literal["scale", "choice", "text", "number"] = "scale"
    low: Text = ""
    """Words at the lower end of a scale."""
    high: Text = ""
    min: float = 1
    max: float = 7
    step: Annotated[float, Meta(gt=0)] = 1
    options: list[Text] = []
    """Options of a choice; the answer is the number of an option, from 0."""
    required: bool = True
    reversed: bool = False
    """True if the scale is reversed when the mean of the form is computed."""
    right: float | list[float] | None = None
    """Right answer or answers (for a choice, the index of the option, from 0). An item with a right answer is a check,
    and does not count in the mean of the form. It is not sent to pages."""

    @property
    def right_answers(self) -> list[float] | None:
        """Right answers of the item; None if it is not a check."""
        return [self.right] if isinstance(self.right, int | float) else self.right

    def is_right(self, answer: float | str | None) -> bool:
        """Return whether an answer passes the check; every answer does if the item is not a check."""
        return self.right_answers is None or answer in self.right_answers


class Form(Record, frozen=True):
    """Form with questions that participants answer on one page."""

    id: Annotated[str, Meta(pattern=r"^([A-Za-z0-9][A-Za-z0-9_.-]{0,39})?$")] = ""
    builtin: str = ""
    """Name of a built-in questionnaire that supplies the items: ``nasa_tlx``, ``fluency`` or ``trust``."""
    after: Literal["consent", "tutorial", "trial", "condition", "end"] = "condition"
    """Stage of the study after which the form is shown; ``trial`` means after each episode."""
    attempts: Count = 1
    """Number of attempts to answer the checks (items with ``right``)."""
    fail: Literal["screen_out", "note"] = "screen_out"
    """Consequence when no attempt is left: the session ends, or the failure is only noted for the report and its rules."""
    again: Text = ""
    """Text above the form when a check was not passed and another attempt is left."""
    conditions: list[str] = []
    """Conditions after which the form is shown (default: all; built-in forms about the robot are omitted if there is
    none)."""
    title: Text = ""
    text: Text = ""
    items: list[Item] = []

    @property
    def has_checks(self) -> bool:
        """Return whether the form has items with right and wrong answers."""
        return any(item.right is not None for item in self.items)


class Design(Record, frozen=True):
    """Design of a study: the contents of a study file."""

    name: Name
    version: Name
    title: Text
    participants: Annotated[int, Meta(ge=1, le=10_000)]
    retention: date
    """Day by which recordings and answers are to be deleted."""
    contact: str
    """Contact address for participants, such as an e-mail address."""
    scenes: list[str]
    conditions: list[Condition]
    consent: Consent
    episodes: Count = 10
    """Number of episodes per condition."""
    seed: Annotated[int, Meta(ge=0)] = 0
    languages: list[Name] = msgspec.field(default_factory=lambda: ["en"])
    """Languages of the study; the first is the default."""
    minutes: Count | None = None
    """Duration that is announced to participants [minutes]."""
    about: Text = ""
    """Text that the page shows above the consent text."""
    device: Device = Device()
    tutorial: Tutorial = Tutorial()
    dropout: DropOut = DropOut()
    recruiting: Recruiting = Recruiting()
    forms: list[Form] = []
    exclude: list[Exclude] = []
    bonus: Bonus | None = None
    texts: dict[str, dict[str, str]] = {}
    """Texts of the pages that replace built-in ones, by language and name."""

    @property
    def has_pairs(self) -> bool:
        """Return whether the study has pairs of participants, who play together under some condition."""
        return any(condition.is_shared for condition in self.conditions)

    def condition(self, name: str) -> Condition:
        """Return the condition with a name."""
        return next(c for c in self.conditions if c.name == name)

    def say(self, text: Text, language: str) -> str:
        """Return a text in a language, or in the study's first language if there is no translation."""
        if isinstance(text, str):
            return text
        return (
            text.get(language)
            or text.get(language.partition("-")[0])
            or text.get(self.languages[0])
            or next(iter(text.values()), "")
        )


class Block(msgspec.Struct, frozen=True):
    """Consecutive episodes of one condition in one scene."""

    condition: str
    scene: str
    episodes: tuple[int, ...]


class Place(msgspec.Struct, frozen=True):
    """Plan of one participant's episodes: a practice episode in the first block's scene, then the blocks."""

    practice: tuple[int, ...]
    blocks: tuple[Block, ...]


class StudyPlan(msgspec.Struct, frozen=True, kw_only=True):
    """Plan of a study, which the command makes for the server and the workers."""

    design: Design
    out: str
    """Folder of the study."""
    places: tuple[Place, ...]
    """Places for participants, in the order in which they are assigned."""
    plans: tuple[PlayPlan, ...]
    """Plans of every condition in every scene; the empty name stands for the tutorial."""
    numbers: dict[str, int]
    """Index of the plan in ``plans`` by ``condition|scene``."""
    key_file: str
    """Path of the file with the secret for pseudonyms."""

    def number(self, condition: str, scene: str) -> int:
        """Return the index of the plan of a condition, or of the tutorial (empty name), in a scene."""
        return self.numbers[f"{condition}|{scene}"]
