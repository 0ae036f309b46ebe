"""Language model in a live game, where a thread waits for the model's answers while the game continues."""

from __future__ import annotations

import threading
import time
from queue import Empty, SimpleQueue
from typing import Any

from h3data.policies import Action, RearrangeView
from h3data_llm.endpoint import Endpoint, LanguageModelError, Reply
from sim_kinematic.agents.skills import SkillResult

RETRY_S = 5.0
"""Time after a failed request until the language model is asked again [s]."""


class Thinking(Exception):
    """Exception for a request whose answer has not arrived yet."""


class PatientEndpoint:
    """Endpoint that never blocks; a request is repeated until its answer has arrived."""

    def __init__(self, endpoint: Endpoint) -> None:
        """Create an endpoint without sending a request."""
        self._endpoint = endpoint
        self._answers: SimpleQueue[Reply | LanguageModelError] = SimpleQueue()
        self._is_asked = False

    def ask(self, body: bytes) -> Reply:
        """Return the answer to the body of a request.

        Raises:
            Thinking: the answer has not arrived yet.
            LanguageModelError: the endpoint fails.
        """
        if not self._is_asked:
            self._is_asked = True
            # a daemon: a game that ends does not wait for an answer
            threading.Thread(target=self._fetch, args=(body,), name="h3data language model", daemon=True).start()
        try:
            answer = self._answers.get_nowait()
        except Empty:
            raise Thinking from None
        self._is_asked = False
        if isinstance(answer, LanguageModelError):
            raise answer
        return answer

    def _fetch(self, body: bytes) -> None:
        try:
            self._answers.put(self._endpoint.ask(body))
        except LanguageModelError as fault:
            self._answers.put(fault)
        except Exception as fault:  # whatever it is, the game goes on
            self._answers.put(LanguageModelError(f"{type(fault).__name__}: {fault}", code="H3-LLM-030"))


class BackgroundModel:
    """Policy of a language model in a live game, where the current action continues during the model's computation.

    A robot without an action stands still.
    """

    def __init__(self, policy: Any) -> None:
        """Take over a `h3data_llm.policy.LanguageModelPolicy` with an endpoint that never waits."""
        self._policy = policy
        self._view: RearrangeView | None = None
        """View of the decision that is being made; None if none is being made."""
        self._action: Action | None = None
        self._ended: SkillResult | None = None
        """Last choice, and its result once it has ended."""
        self._retry_at, self.faults = 0.0, list[str]()

    def command(self, view: RearrangeView) -> Action | None:
        """Return the choice for the next step without waiting.

        None means that the current action continues, or that nothing is decided yet.
        """
        if self._view is None:
            last = self._ended
            if self._action is not None and last is None:
                reason = self._policy.interrupts(view._replace(action=self._action, last=None))
                if not reason:
                    return None
                last = SkillResult("aborted", reason)
            if time.monotonic() < self._retry_at:
                return None
            self._view = view._replace(action=self._action, last=last)
        try:
            action = self._policy.act(self._view)
        except Thinking:
            return None
        except LanguageModelError as fault:
            self._view, self._retry_at = None, time.monotonic() + RETRY_S
            self.faults.append(f"step {int(view.step)}: {fault}")
            return None
        self._view = None
        if action == self._action and self._ended is None:
            return None  # it goes on
        self._action, self._ended = action, None
        return action

    def after(self, spans: list[Any]) -> None:
        """Handle the agent's skills that have ended in a step, some of them because a new choice interrupted them."""
        own = [span for span in spans if span.reason != "commanded"]
        if self._action is not None and self._ended is None and own and own[0].name == self._action.skill:
            self._ended = SkillResult(own[0].outcome, own[0].reason)

    def recorded_info(self) -> dict[str, Any]:
        """Return the recorded facts of the policy, with the errors of the endpoint."""
        (found,) = self._policy.recorded_info()["llm"]
        return {"llm": [{**found, **({"faults": self.faults} if self.faults else {})}]}

    def close(self) -> None:
        """Do nothing, because a thread that waits for an answer ends when the answer arrives."""
