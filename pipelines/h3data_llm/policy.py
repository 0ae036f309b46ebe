"""Policy of an agent whose tasks are chosen by a language model."""

from __future__ import annotations

import hashlib
import re
import time
from collections import deque
from typing import Any, NamedTuple

import msgspec

from h3data.errors import InputError
from h3data.policies import Action, AssignedPolicy, PolicyMaker, RearrangeView
from h3data_language.task import Language
from h3data_llm.background import BackgroundModel, PatientEndpoint
from h3data_llm.budget import JobBudget
from h3data_llm.endpoint import Address, Endpoint, HttpEndpoint, LanguageModelError
from h3data_llm.tools import Call, called, kept, lines_of, schemas_of, tools_for
from h3data_llm.work import Work, Worker
from h3data_llm.world_text import WorldText
from sim_kinematic.motion.state import NOBODY

FAULTS = 3
"""Number of consecutive invalid answers after which an episode ends."""
MOST_ANSWER_TOKENS = 600
"""Largest number of tokens of an answer."""
RULES = (
    "You decide what {name}, a {kind}, does in a home, together with {others}, so that this is done: {instruction}\n"
    "Choose one tool at a time. Each is carried out before you are asked again, and you are told how it ended. "
    "Do not do what somebody else is doing. Use names exactly as they are written here."
)
TEXT_RULES = (
    "\nThe tools are:\n{tools}\nAnswer with one or two sentences of thought, and then a last line with one tool and its "
    "arguments in this form, without quotes:\nAction: NAME[ARGUMENT, ARGUMENT]"
)


class Decision(NamedTuple):
    """Answer of a language model, in the form in which recordings store it."""

    step: int
    request: str
    """First 16 digits of the SHA-256 of the body of the request."""
    reply: dict[str, Any]
    """Text of the answer and its first tool call."""
    tokens: tuple[int, int]
    """Tokens of request and answer, as the endpoint counts them."""
    ms: float
    """Time that the answer took [ms]."""
    model: str
    """Name of the model as the endpoint states it."""
    result: str = ""
    """Reason why the answer is invalid; empty if it was carried out."""


def language_model(address: str, task: Any, kind: str, spec: Any = None) -> PolicyMaker:
    """Return the factory of the policy of a language model, which is the entry point ``llm``.

    Args:
        address: Address of the endpoint, as read by `Address.of`.
        task: Task that is played.
        kind: Kind of the agent.
        spec: Rules of the task if a job is checked before it starts; a server must then listen at the address.

    Raises:
        InputError: the address is invalid, agents have no skills in the task, or the budget file has no budget.
        LanguageModelError: no server answers.
    """
    if not task.control.has_skills:
        raise InputError(
            f"Language models choose skills, which agents of {task.name} do not have. Expected a task such as language or "
            "rearrange.",
            code="H3-LLM-023",
        )
    where = Address.of(address)

    def made(episode: Any, number: int) -> AssignedPolicy:
        policy = LanguageModelPolicy(where, HttpEndpoint(where), task, episode, number)
        return AssignedPolicy(policy, policy.name, kind)

    endpoint = HttpEndpoint(where)
    if where.budget:
        JobBudget(where.budget)
    if spec is not None:
        endpoint.check()
    return made


class LanguageModelPolicy:
    """Policy that asks a language model for an agent's next task whenever the previous one has ended."""

    is_remote = True
    """Constant True, because a replay repeats the recorded decisions without asking the language model."""
    interrupts_every = 3
    """Number of steps between two checks whether the current action should stop."""

    def __init__(self, where: Address, endpoint: Endpoint, task: Any, episode: Any, number: int) -> None:
        """Prepare for an episode without sending a request.

        Args:
            where: Address with its options.
            endpoint: Endpoint that answers.
            task: Task that is played.
            episode: Episode that is played.
            number: Number of the agent.
        """
        places = isinstance(task, Language)
        member, names = episode.roster[number], [m.name for m in episode.roster]
        uses = [(str(n), bool(v)) for n, v in episode.extra["uses"]] if places else []
        self.where, self._endpoint, self._number = where, endpoint, number
        self._budget = JobBudget(where.budget) if where.budget else None
        self._text = WorldText(episode, number, places=places)
        self.tools = tools_for(
            self._text.names,
            places=places,
            handles=member.kind == "human" and any(name for name, _ in uses),
            searches=getattr(episode.spec, "observe", "full") == "seen",
        )
        self._worker = Worker(self._text, number, uses)
        others = ", ".join(n for k, n in enumerate(names) if k != number) or "nobody else"
        rules = RULES.format(
            name=member.name,
            kind="person" if member.kind == "human" else "robot, which has no hand for water and switches",
            others=others,
            instruction=task.codec.instruction(episode),
        )
        if where.mode == "text":
            rules += TEXT_RULES.format(tools=lines_of(self.tools))
        self._head = [{"role": "system", "content": rules}]
        self._past: deque[list[dict[str, Any]]] = deque(maxlen=where.history)
        self._seed = int(episode.seed) % 2**31
        self.decisions: list[Decision] = []
        """All answers so far, including invalid ones."""
        self._plans = self._faults = 0
        self._work: Work | None = None
        self._call: tuple[dict[str, Any], Call] | None = None
        self._known = self._heard = 0
        self.name = f"llm:{re.sub(r'[^A-Za-z0-9_.-]+', '_', where.model)[:40].strip('_') or 'model'}@{self._digest()}"
        """Name in recordings: the model, and a digest of options and prompts, and no address."""

    def _digest(self) -> str:
        where = self.where._replace(url="", timeout=0, retries=0)
        told = [RULES, TEXT_RULES, [value for name, value in where._asdict().items() if name != "budget"]]
        return hashlib.sha256(msgspec.json.encode(told)).hexdigest()[:12]

    # --- decisions ----------------------------------------------------------------------------------------------------
    def act(self, view: RearrangeView) -> Action:
        """Return the next skill of the current task, or of a new task that the language model chooses now.

        Raises:
            LanguageModelError: the endpoint fails, `FAULTS` consecutive answers are invalid, or a budget is used up
                (`h3data_llm.budget.BudgetSpentError` for that of the job).
        """
        result = ""
        while True:
            try:
                if self._work is None:
                    self._work = self._next_work(view, result)
                    action = next(self._work)
                else:
                    action = self._work.send(view)
            except StopIteration as end:
                self._work, result = None, str(end.value)
                continue
            self._known, self._heard = self._worker.known(view), self._worker.heard(view)
            return action

    def interrupts(self, view: RearrangeView) -> str:
        """Return the reason to stop the current action.

        Reasons are a message that arrives while waiting, a thing found in a search, or a thing that another agent has
        taken.
        """
        action, reason = view.action, self._worker.reason
        if reason == "message" and self._worker.heard(view) > self._heard:
            return "message"
        if reason == "found" and self._worker.known(view) > self._known:
            return "found"
        if action is None or action.skill not in ("nav_to_object", "pick"):
            return ""
        return "object_taken" if view.held_by[action.target] not in (NOBODY, self._number) else ""

    def _next_work(self, view: RearrangeView, result: str) -> Work:
        """Ask until an answer means something."""
        if self._call is not None and result:
            self._remember(self._call[0], result)
        self._call = None
        if self._plans >= self.where.plans:
            return self._worker.rest(view, for_good=True)
        while True:
            reply = self._ask(view)
            try:
                call = called(reply, self.tools, self._text.names, self.where.mode)
            except LanguageModelError as fault:
                self.decisions[-1] = self.decisions[-1]._replace(result=str(fault))
                self._faults += 1
                if self._faults >= FAULTS:
                    raise LanguageModelError(
                        f"{FAULTS} answers of the language model {self.where.model!r} in a row mean nothing. The last: {fault}",
                        code=fault.code,
                    ) from None
                self._remember(reply, str(fault))
                continue
            self._faults, self._plans, self._call = 0, self._plans + 1, (reply, call)
            return self._worker.begin(call, view)

    def _remember(self, reply: dict[str, Any], result: str) -> None:
        """Keep an answer and what became of it for later requests."""
        tool_calls = reply.get("tool_calls") if self.where.mode == "tools" else None
        number = f"call_{len(self.decisions)}"
        said: dict[str, Any] = {"role": "assistant", "content": reply["content"] or ("" if tool_calls else "(nothing)")}
        heard: dict[str, Any] = {"role": "user", "content": result}
        if tool_calls:
            said["tool_calls"] = [{"id": number, "type": "function", **tool_calls[0]}]
            heard = {"role": "tool", "tool_call_id": number, "content": result}
        self._past.append([said, heard])

    def request(self, view: RearrangeView) -> bytes:
        """Return the body of the request for the next decision."""
        handled = sorted(self._worker.handled)
        now = self._text.state(view, [f"You have handled: {', '.join(handled)}."] if handled else [])
        left = f"You may choose {self.where.plans - self._plans} more times."
        messages: list[dict[str, Any]] = [*self._head, {"role": "user", "content": self._text.home()}]
        messages += [dict(message) for pair in self._past for message in pair]
        messages[-1] = {**messages[-1], "content": f"{messages[-1]['content']}\n\nNow:\n{now}\n{left}"}
        body: dict[str, Any] = {
            "model": self.where.model,
            "messages": messages,
            "temperature": 0,
            "seed": self._seed,
            "max_tokens": MOST_ANSWER_TOKENS,
        }
        if self.where.mode == "tools":
            body |= {"tools": schemas_of(self.tools, self._text.names), "tool_choice": "required"}
        return msgspec.json.encode(body)

    def _ask(self, view: RearrangeView) -> dict[str, Any]:
        if len(self.decisions) >= self.where.calls:
            raise self._spent("calls", len(self.decisions), view)
        used = sum(sum(decision.tokens) for decision in self.decisions)
        if used >= self.where.tokens:
            raise self._spent("tokens", used, view)
        if self._budget is not None:
            self._budget.check()
        body, begun = self.request(view), time.perf_counter()
        answer = self._endpoint.ask(body)
        if self._budget is not None:
            self._budget.add(sum(answer.tokens))
        ms, digest = round((time.perf_counter() - begun) * 1e3, 3), hashlib.sha256(body).hexdigest()[:16]
        reply = kept(answer.message)
        self.decisions.append(Decision(int(view.step), digest, reply, answer.tokens, ms, answer.model))
        return reply

    def _spent(self, what: str, used: int, view: RearrangeView) -> LanguageModelError:
        return LanguageModelError(
            f"The budget of the language model {self.where.model!r} is used up at step {view.step}: {used:,} {what}. Hint: "
            f"allow more with &{what}= in its address.",
            code="H3-LLM-024",
        )

    def in_background(self) -> BackgroundModel:
        """Return the policy for live games, which never wait for an answer."""
        self._endpoint = PatientEndpoint(self._endpoint)
        return BackgroundModel(self)

    def recorded_info(self) -> dict[str, Any]:
        """Return the recorded facts about the language model, with every answer."""
        facts = {
            "policy": self.name,
            "agent": self._number,
            "endpoint": self.where.url,
            "options": {k: v for k, v in self.where._asdict().items() if k not in ("url", "budget")},
            "calls": len(self.decisions),
            "tokens": [sum(d.tokens[n] for d in self.decisions) for n in (0, 1)],
            "decisions": [{**d._asdict(), "tokens": list(d.tokens)} for d in self.decisions],
        }
        return {"llm": [facts]}
