"""Cost of language models in an episode (requests, tokens and waiting time), computed from the recorded answers alone.

The profile ``llm`` measures any recording in which a language model took part: ``h3data metrics ds --profile llm``.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

from h3data.errors import InputError
from h3data.metrics import Metric, Profile
from h3data.metrics.episode import Notes
from h3data.metrics.metric import INF
from h3data.metrics.profile import Computed
from h3data.metrics.requirements import UnmeasurableError, note_missing
from h3data.recording import Recording
from h3data_llm.policy import Decision
from h3data_llm.replies import models_in

_ANSWERS = "info:llm"


class ModelUse(NamedTuple):
    """Cost of a list of answers of language models."""

    calls: int
    """Number of answers."""
    plans: int
    """Number of answers that were carried out."""
    tokens: int
    """Number of tokens of requests and answers, as the endpoint counts them."""
    tokens_out: int
    """Number of tokens of the answers alone."""
    seconds: float
    """Sum of the times that the answers took [s]."""

    @classmethod
    def of(cls, decisions: Iterable[Decision]) -> ModelUse:
        """Return the cost of recorded answers."""
        told = list(decisions)
        return cls(
            len(told),
            sum(not d.result for d in told),
            sum(sum(d.tokens) for d in told),
            sum(d.tokens[1] for d in told),
            sum(d.ms for d in told) / 1e3,
        )


def _metric(name: str, title: str, formula: str, unit: str, source: str = "h3data") -> Metric:
    return Metric(
        id=f"llm/any/{name}@1",
        name=name,
        title=title,
        formula=formula,
        unit=unit,
        range=(0.0, INF),
        direction="lower",
        source=source,
        columns=(_ANSWERS,),
        undefined="No language model has played.",
        reading="All agents together.",
    )


LLM_METRICS = (
    _metric("calls", "Answers of language models", "number of answers", "1"),
    _metric("plans", "Decisions", "number of answers without a fault", "1", "PARTNR (2411.00081), planning cycles"),
    _metric("tokens", "Tokens", "sum of tokens of requests and answers, as the endpoint counts them", "1"),
    _metric("tokens_out", "Tokens of answers", "sum of tokens of answers, as the endpoint counts them", "1"),
    _metric("seconds", "Time of answers", "sum of ms of the answers * 1e-3", "s"),
)


def compute_use(recording: Recording, notes: Notes) -> Computed:
    """Compute the metrics of the profile ``llm``.

    Raises:
        MissingColumnsError: no language model took part.
        UnmeasurableError: the recorded answers are malformed.
    """
    note_missing(LLM_METRICS, recording, notes)
    try:
        models = models_in(recording)
    except InputError as fault:
        raise UnmeasurableError(str(fault), str(fault), code=fault.code) from None
    use = ModelUse.of(d for model in models for d in model.decisions)
    return Computed(values={name: float(value) for name, value in use._asdict().items()})


PROFILE = Profile(
    name="llm",
    title="Cost of language models: answers, tokens and time",
    metrics=LLM_METRICS,
    compute=compute_use,
    beside="llm",
)
