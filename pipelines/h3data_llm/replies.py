"""Listing of the recorded answers of language models, and their execution again with the current prompts and parser."""

from __future__ import annotations

from typing import Any, NamedTuple

import msgspec

from h3data.errors import InputError
from h3data.plugins import names_from_data
from h3data.recording import Recording
from h3data_llm.endpoint import Address, LanguageModelError, Reply
from h3data_llm.policy import Decision, LanguageModelPolicy
from sim_kinematic.tasks.resimulation import first_difference, scene_and_map
from sim_kinematic.tasks.resume import resume, task_of


class RecordedModel(NamedTuple):
    """A language model, described in a recording."""

    policy: str
    agent: int
    where: Address
    """Options of the model, without its address."""
    decisions: tuple[Decision, ...]


def models_in(recording: Recording) -> list[RecordedModel]:
    """Return the language models of a recording, with their answers.

    Raises:
        InputError: the recording names no language model, or its entry is malformed.
    """
    told = recording.episode.info.get("llm")
    if not told:
        raise InputError(
            f"No language model has played the recording {recording.episode.episode_id!r}. Hint: its policy begins with llm:.",
            code="H3-LLM-025",
        )
    try:
        found = msgspec.convert(told, list[dict[str, Any]])
        models = [
            RecordedModel(
                str(each["policy"]),
                msgspec.convert(each["agent"], int),
                # a recording names no file of this machine
                _record(Address, {**each["options"], "url": "http://recorded", "budget": ""}),
                tuple(_record(Decision, d) for d in each["decisions"]),
            )
            for each in found
        ]
    except (msgspec.ValidationError, AttributeError, KeyError, TypeError) as fault:
        why = " ".join(str(fault).replace("`", "").split())[:200]
        raise InputError(f"Malformed entry llm in the info of the recording: {why}.", code="H3-LLM-026") from None
    if any(not 0 <= model.agent < len(recording.agents) for model in models):
        raise InputError("An entry llm in the info is of an agent that is not in the recording.", code="H3-LLM-027")
    return models


def _record(kind: Any, told: Any) -> Any:
    """Return a named tuple from its fields as JSON types."""
    return msgspec.convert([told.get(f, kind._field_defaults.get(f)) for f in kind._fields], kind)


class RecordedEndpoint:
    """Endpoint that gives the recorded answers, in order."""

    def __init__(self, decisions: tuple[Decision, ...]) -> None:
        """Start with the first recorded answer."""
        self._left = list(decisions)

    def ask(self, body: bytes) -> Reply:
        """Return the next recorded answer.

        Raises:
            LanguageModelError: all recorded answers have been used.
        """
        if not self._left:
            raise LanguageModelError("The recording has no further answers.", code="H3-LLM-028")
        decision = self._left.pop(0)
        return Reply(decision.reply, decision.model, decision.tokens)


class Replayed(NamedTuple):
    """Comparison of recorded answers with their meaning to the current parser."""

    model: RecordedModel
    request: int
    """Number of the first request that differs today; -1 if none differs."""
    meaning: int
    """Number of the first answer that is valid today and was invalid when recorded, or the reverse; -1 if there is
    none.
    """
    step: int
    """First step at which the episode differs; -1 if none differs."""
    fault: str = ""
    """Reason, as a sentence, why the episode could not be played to its end."""


def played_again(recording: Recording) -> list[Replayed]:
    """Carry out recorded answers with the current prompts and parser, without an endpoint; other agents decide again.

    Raises:
        InputError: no language model took part, or the recording cannot be simulated again.
    """
    models, task = models_in(recording), task_of(recording)
    file = recording.attachments.get("scene.glb")
    if file is None:
        raise InputError("The recording has no scene, so that it cannot be played again.", code="H3-LLM-029")
    with names_from_data():
        episode = task.codec.restore(recording, lambda radius, height: scene_and_map(file, radius, height))
    policies: dict[int, LanguageModelPolicy] = {}
    for model in models:
        endpoint = RecordedEndpoint(model.decisions)
        policies[model.agent] = LanguageModelPolicy(model.where, endpoint, task, episode, model.agent)
    chosen = {recording.agents[k].name: policy for k, policy in policies.items()}
    step, fault = -1, ""
    try:
        again = resume(recording, 0, agents=chosen)
    except LanguageModelError as stop:
        fault = str(stop)
    else:
        difference = first_difference(recording.columns, again.columns)
        rows = min(len(recording), len(again))
        step = difference.step if difference is not None else rows if len(again) != len(recording) else -1
    return [
        Replayed(
            model,
            _first(
                [a.request != b.request for a, b in zip(model.decisions, policies[model.agent].decisions, strict=False)]
            ),
            _first(
                [a.result != b.result for a, b in zip(model.decisions, policies[model.agent].decisions, strict=False)]
            ),
            step,
            fault,
        )
        for model in models
    ]


def _first(flags: list[bool]) -> int:
    return flags.index(True) if True in flags else -1
