"""Reading and checking of a study file, and assignment of episodes to participants.

This module runs in the command, not in the server.
"""

from __future__ import annotations

import math
import os
import re
import tomllib
from pathlib import Path

import msgspec

from h3data.errors import H3DataError, InputError, did_you_mean
from h3data.scene.open import named_scenes
from h3data_play.live import EpisodeFactory
from h3data_play.plan import PlayPlan
from h3data_studies.analysis.planning import plan_sessions
from h3data_studies.design import Block, Condition, Consent, Design, Exclude, Form, Place, StudyPlan, Text
from h3data_studies.exclusions import PARTICIPANT_MEASURES, TRIAL_MEASURES
from h3data_studies.forms import BUILTIN, checked_answers, resolved
from h3data_studies.pseudonyms import IDS
from h3data_studies.store import DATABASE, StudyStore
from h3data_studies.texts import ENGLISH, LIVE, SHIPPED, missing, shipped
from sim_kinematic.policies.learned import PREFIX as WEIGHTS
from sim_kinematic.policies.learned import stamped

DESIGN_FILE = "design.json"
"""Name of the copy of the study file in the study's folder, made when the first participant arrives."""
_SECTION = re.compile(r" - at `\$\.?(.*)`$")


def read_design(path: Path) -> Design:
    """Read the study file at ``path`` and check everything that does not need the simulator.

    Raises:
        InputError: the file cannot be read, or a value is invalid; the message names the place in the file.
    """
    try:
        text = path.read_bytes()
        data = tomllib.loads(text.decode())
    except OSError as fault:
        raise InputError(
            f"Cannot read the study file ({fault.strerror}): {path}. Hint: h3data study new {path}", code="H3-STUDY-030"
        ) from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as fault:
        raise InputError(f"The study file is not valid TOML: {fault}. File: {path}", code="H3-STUDY-031") from None
    try:
        design = msgspec.convert(data, Design)
    except msgspec.ValidationError as fault:
        raise InputError(f"{_in_words(str(fault))} File: {path}", code="H3-STUDY-032") from None
    design = _with_consent(design, path)
    try:
        _check(design)
        design = _with_weights(design, path)
    except InputError as fault:
        raise InputError(f"{fault} File: {path}", code=fault.code) from None
    return design


def _in_words(fault: str) -> str:
    """Return an error such as ``Object contains unknown field `x` - at `$.device` `` as a sentence."""
    found = _SECTION.search(fault)
    where = re.sub(r"\[(\d+)\]", lambda m: f" number {int(m[1]) + 1}", found[1]).replace(".", ", ") if found else ""
    text = _SECTION.sub("", fault)
    if unknown := re.search(r"unknown field `(.*)`", text):
        text = f"Unknown setting {unknown[1]!r}"
    elif missing := re.search(r"missing required field `(.*)`", text):
        text = f"The setting {missing[1]!r} is missing"
    else:
        text = text.replace("`", "'")
    return f"{text}{f' in {where}' if where else ''}."


def _with_consent(design: Design, path: Path) -> Design:
    consent = design.consent
    if consent.file and consent.text:
        raise InputError(f"Give the consent's text or its file, not both. File: {path}", code="H3-STUDY-015")
    if consent.file:
        file = path.parent / consent.file
        try:
            text = file.read_text("utf-8")
        except (OSError, UnicodeDecodeError) as fault:
            raise InputError(f"Cannot read the text of the consent ({fault}): {file}", code="H3-STUDY-045") from None
        design = msgspec.structs.replace(design, consent=Consent(version=consent.version, text=text))
    if not design.consent.text:
        raise InputError(f"The consent has no text: set text or file in [consent]. File: {path}", code="H3-STUDY-016")
    return design


def _with_weights(design: Design, path: Path) -> Design:
    """Return files of weights relative to the study file's folder, with their digest.

    Other weights make another study.
    """
    base, conditions = path.parent.resolve(), []
    for condition in design.conditions:
        if condition.partner is not None and condition.partner.startswith(WEIGHTS):
            file = base / Path(condition.partner.removeprefix(WEIGHTS)).expanduser()
            condition = msgspec.structs.replace(condition, partner=stamped(f"{WEIGHTS}{file}"))
        conditions.append(condition)
    return _with_relative(msgspec.structs.replace(design, conditions=conditions), base)


def _with_relative(design: Design, base: Path) -> Design:
    """Return files of weights relative to the study file's folder, because paths of this machine are private."""
    conditions = [
        msgspec.structs.replace(c, partner=WEIGHTS + os.path.relpath(c.partner.removeprefix(WEIGHTS), base))
        if c.partner is not None and c.partner.startswith(f"{WEIGHTS}/")
        else c
        for c in design.conditions
    ]
    return msgspec.structs.replace(design, conditions=conditions)


def _check(design: Design) -> None:
    _distinct("conditions", [c.name for c in design.conditions])
    if design.has_pairs and design.participants % 2:
        raise InputError(
            "Expected an even number of participants, because a condition is played by two together, got "
            f"{design.participants}.",
            code="H3-STUDY-051",
        )
    if not design.conditions:
        raise InputError("Expected at least one [[conditions]].", code="H3-STUDY-017")
    if not design.scenes:
        raise InputError('Expected at least one of scenes, such as scenes = ["small:1"].', code="H3-STUDY-018")
    if not design.languages:
        raise InputError('Expected at least one of languages, such as languages = ["en"].', code="H3-STUDY-019")
    if not re.search(r"\S", design.contact):
        raise InputError("Expected whom participants ask (contact), such as an e-mail address.", code="H3-STUDY-020")
    for language, words in design.texts.items():
        if language not in design.languages:
            raise InputError(f"[texts.{language}] is of a language that languages does not name.", code="H3-STUDY-033")
        known = [*ENGLISH, *(f"live_{name}" for name in LIVE)]
        if unknown := [name for name in words if name not in known]:
            raise InputError(
                f"There is no text {unknown[0]!r} in [texts.{language}].{did_you_mean(unknown[0], known)} Expected some of: "
                f"{', '.join(known)}.",
                code="H3-STUDY-034",
            )
    for language in design.languages:
        _check_language(design, language)
    _check_patterns(design.recruiting.id_pattern)
    names = {c.name for c in design.conditions}
    forms = [resolved(_known(form)) for form in design.forms]
    for form in forms:
        if not form.id or not form.items:
            raise InputError(
                'Every one of [[forms]] needs a builtin, or an id and items: builtin = "nasa_tlx".', code="H3-STUDY-035"
            )
        if strangers := set(form.conditions) - names:
            raise InputError(
                f"The form {form.id} names a condition that is not there: {sorted(strangers)[0]}.", code="H3-STUDY-036"
            )
        if form.conditions and form.after not in ("condition", "trial"):
            raise InputError(
                f'The form {form.id} names conditions, so it needs after = "condition" or "trial".', code="H3-STUDY-037"
            )
        _distinct(f"items of the form {form.id}", [item.id for item in form.items])
        _check_answers(form)
        for item in form.items:
            if item.kind == "choice" and len(item.options) < 2:
                raise InputError(
                    f"The choice {item.id} of the form {form.id} needs two options or more.", code="H3-STUDY-046"
                )
            if not item.min < item.max:
                raise InputError(
                    f"The item {item.id} of the form {form.id} needs a min below its max.", code="H3-STUDY-047"
                )
    # practice has no number by which a page could tell the two apart
    _distinct("forms", [f"{form.id} after the {form.after}".replace("tutorial", "consent") for form in forms])
    _distinct("rules of [[exclude]]", [rule.name for rule in design.exclude])
    for rule in design.exclude:
        _check_rule(rule)
    if design.recruiting.unique_codes and design.recruiting.completion_code:
        raise InputError("Give completion_code, or unique_codes = true, not both.", code="H3-STUDY-021")
    for text in _texts(design):
        if isinstance(text, dict) and (strange := set(text) - set(design.languages)):
            raise InputError(
                f"A text is in the language {sorted(strange)[0]!r}, which languages does not name.", code="H3-STUDY-038"
            )
        if isinstance(text, dict) and (lacks := [language for language in design.languages if language not in text]):
            raise InputError(f"A text lacks the study's language {lacks[0]!r}: {text}", code="H3-STUDY-039")


def _check_language(design: Design, language: str) -> None:
    """Check that the texts are complete in each language, because a participant reads everything in one language."""
    lacks = missing(design, language)
    if lacks:
        shown = ", ".join(lacks[:8]) + (f" and {len(lacks) - 8} more" if len(lacks) > 8 else "")
        raise InputError(
            f"There are no texts in the language {language!r}: the package has {', '.join(SHIPPED)}. Expected in "
            f"[texts.{language}] also: {shown}.",
            code="H3-STUDY-022",
        )
    if shipped(language) is None and (builtin := [form.builtin for form in design.forms if form.builtin]):
        raise InputError(
            f"The built-in form {builtin[0]} has no texts in the language {language!r}, only in {', '.join(SHIPPED)}. Expected "
            "a form with items of its own.",
            code="H3-STUDY-023",
        )


def _check_answers(form: Form) -> None:
    """Check that the right answers of a form can be given, and that only forms with checks have attempts."""
    for item in form.items:
        right = item.right_answers
        if right is None:
            continue
        if item.kind == "text" or not right:
            raise InputError(
                f"The item {item.id} of the form {form.id} needs numbers as right answers, and is no text.",
                code="H3-STUDY-040",
            )
        for value in right:
            why = checked_answers(Form(id=form.id, items=[item]), {item.id: value})[1]
            if why:
                raise InputError(
                    f"The right answer of the item {item.id} of the form {form.id} cannot be given. {why}",
                    code="H3-STUDY-048",
                )
    if not form.has_checks and (form.attempts != 1 or form.fail != "screen_out" or form.again):
        raise InputError(
            f"The form {form.id} has attempts, fail or again, so one of its items needs a right answer.",
            code="H3-STUDY-024",
        )


def _check_rule(rule: Exclude) -> None:
    measures = PARTICIPANT_MEASURES if rule.of == "participant" else TRIAL_MEASURES
    if rule.what not in measures:
        raise InputError(
            f"The rule {rule.name} of [[exclude]] asks for {rule.what!r}.{did_you_mean(rule.what, measures)} Expected for "
            f'of = "{rule.of}" one of: {", ".join(measures)}.',
            code="H3-STUDY-025",
        )
    if rule.above is None and rule.below is None:
        raise InputError(f"The rule {rule.name} of [[exclude]] needs above or below.", code="H3-STUDY-026")


def with_id_pattern(design: Design, pattern: str | dict[str, str] | None) -> Design:
    """Return the design with other formats of participants' ids."""
    recruiting = msgspec.structs.replace(design.recruiting, id_pattern=pattern)
    return msgspec.structs.replace(design, recruiting=recruiting)


def _check_patterns(given: str | dict[str, str] | None) -> None:
    patterns = {"PROLIFIC_PID": given} if isinstance(given, str) else given or {}
    for name, pattern in patterns.items():
        if name not in IDS:
            raise InputError(
                f"Unknown id {name!r} in id_pattern.{did_you_mean(name, IDS)} Expected: {', '.join(IDS)}.",
                code="H3-STUDY-041",
            )
        try:
            re.compile(pattern)
        except re.error as fault:
            raise InputError(
                f"The id_pattern of {name} is not a regular expression ({fault}): {pattern!r}.", code="H3-STUDY-049"
            ) from None


def _known(form: Form) -> Form:
    name = form.builtin
    if name and name not in BUILTIN:
        raise InputError(
            f"Unknown built-in form {name!r}.{did_you_mean(name, BUILTIN)} Expected one of: {', '.join(BUILTIN)}.",
            code="H3-STUDY-027",
        )
    return form


def _texts(design: Design) -> list[Text]:
    texts: list[Text] = [design.title, design.about, design.consent.text, design.tutorial.text]
    texts += [c.text for c in design.conditions]
    for form in design.forms:
        texts += [form.title, form.text, form.again]
        for item in form.items:
            texts += [item.text, item.low, item.high, *item.options]
    return texts


def _distinct(what: str, names: list[str]) -> None:
    if len(set(names)) != len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise InputError(f"Expected different {what}, got {twice!r} twice.", code="H3-STUDY-028")


def study_folder(path: Path, design: Design) -> Path:
    """Return the folder of a study's recordings, which is next to its file and has its name and version."""
    return path.parent / f"{design.name}-{design.version}"


def bots_folder(folder: Path) -> Path:
    """Return the folder for the data of scripted participants, which is next to the study's ``folder``."""
    return folder.with_name(folder.name + "-bots")


def deal(design: Design) -> tuple[Place, ...]:
    """Assign conditions, scenes and episodes to all participants; both members of a pair get the same.

    Raises:
        InputError: there are no such scenes.
    """
    scenes = scene_names(design)
    practice = 0 if design.tutorial.skip else 1
    together = 2 if design.has_pairs else 1
    pool = [str(k) for k in range(math.ceil(len(design.conditions) / len(scenes)) * design.episodes + practice)]
    sessions = plan_sessions(
        design.participants // together,
        [c.name for c in design.conditions],
        dict.fromkeys(scenes, pool),
        episodes_per_condition=design.episodes,
        training_episodes=practice,
        study=design.name,
        seed=design.seed,
    )
    return tuple(
        Place(
            practice=tuple(int(e) for e in session.training),
            blocks=tuple(Block(b.condition, b.scene, tuple(int(e) for e in b.episodes)) for b in session.blocks),
        )
        for session in sessions
        for _ in range(together)
    )


def scene_names(design: Design) -> list[str]:
    """Return a distinct name for each home of a study."""
    return list(dict.fromkeys(named.name for text in design.scenes for named in named_scenes(text)))


def make_plan(design: Design, folder: Path, *, speed: float = 1.0) -> StudyPlan:
    """Prepare a study for a server; a ``speed`` above 1 accelerates the clock for scripted participants.

    Raises:
        InputError: there are no such scenes, apps, policies or rules.
    """
    plans: list[PlayPlan] = []
    numbers: dict[str, int] = {}
    for name, condition in (("", _tutorial(design)), *((c.name, c) for c in design.conditions)):
        for scene in scene_names(design):
            plan = PlayPlan(
                app=condition.app,
                out=str(folder.resolve()),
                seats=condition.seats,
                partner=condition.partner,
                scenes=scene,
                seed=design.seed,
                speed=speed,
                rules=condition.rules,
                names=condition.names,
                weights_in=str(folder.resolve().parent),
            )
            if not any(key.startswith(f"{name}|") for key in numbers):
                _check_playable(name, plan)
            numbers[f"{name}|{scene}"] = len(plans)
            plans.append(plan)
    return StudyPlan(
        design=design,
        out=str(folder.resolve()),
        places=deal(design),
        plans=tuple(plans),
        numbers=numbers,
        key_file=str(key_file(folder)),
    )


def key_file(folder: Path) -> Path:
    """Return the file of a study's secret, which is outside its folder so that a copy of the folder lacks it."""
    return folder.resolve().with_name(folder.resolve().name + ".key")


def _check_playable(name: str, plan: PlayPlan) -> None:
    try:
        EpisodeFactory(plan)
    except (
        H3DataError,
        TypeError,
    ) as fault:  # a language model that is not there; TypeError: rules that the task does not have
        where = f"condition {name}" if name else "tutorial"
        raise InputError(
            f"The {where} cannot be played: {str(fault).replace('replace() got', 'rules have')}", code="H3-STUDY-042"
        ) from None


def _tutorial(design: Design) -> Condition:
    """Return the tutorial as a condition, in the seat of the first one."""
    said = design.tutorial
    return Condition(
        name="tutorial", app=said.app, play_as=design.conditions[0].seats[0], partner="solo", rules=said.rules
    )


def open_study(path: Path) -> tuple[Path, Design]:
    """Return the folder and design of a study that has started, or else of its scripted participants.

    ``path`` is the study file or its folder.

    Raises:
        InputError: there is no such study, or it has not started.
    """
    folder = path if path.is_dir() else study_folder(path, read_design(path))
    if not (folder / DESIGN_FILE).is_file() and (bots_folder(folder) / DESIGN_FILE).is_file():
        folder = bots_folder(folder)
    try:
        design = msgspec.json.decode((folder / DESIGN_FILE).read_bytes(), type=Design)
    except FileNotFoundError:
        raise InputError(
            f"Expected a study file or the folder of a study, in which there is a {DESIGN_FILE}: {folder}. Hint: h3data study "
            "run begins a study.",
            code="H3-STUDY-043",
        ) from None
    except msgspec.MsgspecError as fault:
        raise InputError(
            f"The study's {DESIGN_FILE} is damaged or of another version: {fault}. Folder: {folder}",
            code="H3-STUDY-044",
        ) from None
    return folder, _with_relative(design, folder.resolve().parent)  # versions before 0.3 kept the whole path


def open_store(folder: Path, design: Design, *, read_only: bool = True) -> StudyStore:
    """Open the store of a study's participants; changes are not written if it is ``read_only``.

    Raises:
        InputError: no participant has joined.
    """
    if not (folder / DATABASE).is_file():
        bots = bots_folder(folder)
        hint = f"bots have: {bots}" if (bots / DATABASE).is_file() else "h3data study run begins it."
        raise InputError(f"Nobody has taken part in this study yet: {folder}. Hint: {hint}", code="H3-STUDY-029")
    return StudyStore(design, deal(design), folder, read_only=read_only)
