"""Tools with which a language model chooses its agent's actions, with their schemas and the parsing of calls."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import msgspec

from h3data.errors import suggest
from h3data.policies import LONGEST_MESSAGE
from h3data_language.grounding import FLOOR
from h3data_language.templates import HANDLING
from h3data_llm.endpoint import LanguageModelError
from sim_kinematic.agents.skills import INSIDE

LONGEST_WAIT_S = 60
MOST_CONTENT = 4000
"""Largest number of characters of an answer's text; the rest is cut off."""
_ACTION = re.compile(r"^[ \t]*Action:[ \t]*(\w+)[ \t]*\[(.*)\][ \t.]*$", re.MULTILINE)


class Parameter(NamedTuple):
    """Parameter of a tool."""

    name: str
    kind: str
    """Kind of value: ``thing``, ``place``, ``room``, ``opening``, ``agent``, ``handling``, ``text``, ``seconds`` or
    ``how``."""
    about: str
    optional: bool = False


class Tool(NamedTuple):
    """Action that a language model can choose for its agent."""

    name: str
    about: str
    parameters: tuple[Parameter, ...] = ()


class Call(NamedTuple):
    """Call of a tool with checked arguments."""

    tool: str
    arguments: Mapping[str, Any]

    def __str__(self) -> str:
        return f"{self.tool}[{', '.join(str(value) for value in self.arguments.values())}]"


class Names(NamedTuple):
    """Names that may be arguments of tools."""

    things: tuple[str, ...]
    places: tuple[str, ...] = ()
    """Furniture, and rooms in which things can be put."""
    rooms: tuple[str, ...] = ()
    openings: tuple[str, ...] = ()
    """Doors and drawers."""
    agents: tuple[str, ...] = ()
    """The other agents."""

    def of(self, kind: str) -> tuple[str, ...]:
        """Return the names that are valid for a kind of parameter; empty for kinds without names."""
        known = {
            "thing": self.things,
            "place": self.places,
            "room": self.rooms,
            "opening": self.openings,
            "agent": self.agents,
            "handling": (*HANDLING,),
            "how": ("on", *PREFIXES),
        }
        return known.get(kind, ())


PREFIXES = {"inside": INSIDE, "floor": FLOOR}
"""Prefixes of names of places, by the words for them in calls."""
_THING = Parameter("thing", "thing", "name of the thing")
_WHERE = (
    Parameter("place", "place", "name of the furniture or room"),
    Parameter("how", "how", "on (default); inside: in a drawer or behind a door; floor: of a room", optional=True),
    Parameter("next_to", "thing", "name of another thing, to put it next to that", optional=True),
)


def tools_for(names: Names, *, places: bool, handles: bool, searches: bool) -> tuple[Tool, ...]:
    """Return the tools of an agent.

    Args:
        names: Names in the home.
        places: True if the agent chooses where things go; otherwise each thing has one goal.
        handles: True if the agent can clean, fill, pour out and switch on things.
        searches: True if the agent knows only what it has seen.
    """
    where, there = (_WHERE, "to a place") if places else ((), "to its goal")
    tools = [
        Tool(
            "bring",
            f"Go to a thing, take it, bring it {there} and put it down. Opens what is in the way.",
            (_THING, *where),
        ),
        Tool("pick", "Go to a thing and take it. You can hold one thing.", (_THING,)),
        Tool("place", f"Bring the thing in your hand {there} and put it down.", where),
    ]
    if handles:
        do = Parameter("do", "handling", "clean; fill; pour (pour out what is in it); power (switch on)")
        tools.append(Tool("handle", "Go to a thing and do something to it.", (_THING, do)))
    if names.openings:
        opening = Parameter("name", "opening", "name of the door or drawer")
        tools += [
            Tool("open", "Go to a door or drawer and open it, with an empty hand.", (opening,)),
            Tool("close", "Go to a door or drawer and close it, with an empty hand.", (opening,)),
        ]
    if searches:
        room = Parameter("room", "room", "name of the room; leave out to search everywhere", optional=True)
        tools.append(Tool("explore", "Look for things that nobody has seen yet, until you see a new one.", (room,)))
    if names.agents:
        text = Parameter("text", "text", f"up to {LONGEST_MESSAGE} characters")
        tools.append(Tool("say", "Tell the others something. Takes no time.", (text,)))
    seconds = Parameter("seconds", "seconds", f"1 to {LONGEST_WAIT_S}")
    tools += [
        Tool("wait", "Wait, or until somebody says something to you.", (seconds,)),
        Tool("done", "Your part of the work is done. You are asked again only if somebody says something to you."),
    ]
    return tuple(tools)


def schemas_of(tools: Sequence[Tool], names: Names) -> list[dict[str, Any]]:
    """Return the tools in the JSON format of chat requests, without the names of furniture.

    These names appear only in the text about the home.
    """
    return [
        {
            "type": "function",
            "function": {
                "name": tool.name,
                "description": tool.about,
                "parameters": {
                    "type": "object",
                    "properties": {p.name: _schema(p, names) for p in tool.parameters},
                    "required": [p.name for p in tool.parameters if not p.optional],
                },
            },
        }
        for tool in tools
    ]


def _schema(parameter: Parameter, names: Names) -> dict[str, Any]:
    known = names.of(parameter.kind)
    listed = {"enum": list(known)} if known and parameter.kind not in ("place", "opening") else {}
    kind = "integer" if parameter.kind == "seconds" else "string"
    return {"type": kind, "description": parameter.about, **listed}


def lines_of(tools: Sequence[Tool]) -> str:
    """Return the tools as text, for models without tool calls."""
    lines = []
    for tool in tools:
        shown = ", ".join(f"{p.name}{'?' if p.optional else ''}" for p in tool.parameters)
        about = "; ".join(f"{p.name}: {p.about}" for p in tool.parameters)
        lines.append(f"{tool.name}[{shown}] {tool.about}{f' ({about})' if about else ''}")
    return "\n".join(lines)


# --- answers ----------------------------------------------------------------------------------------------------------
def called(message: Mapping[str, Any], tools: Sequence[Tool], names: Names, mode: str) -> Call:
    """Return the first tool call in an answer.

    Args:
        message: Message of the model, cut to size by `kept`.
        tools: The agent's tools.
        names: Names that arguments may have.
        mode: ``tools`` or ``text``.

    Raises:
        LanguageModelError: the answer has no call, or the tool or an argument is wrong; the error message is also meant
            for the model.
    """
    content, calls = message.get("content"), message.get("tool_calls")
    if mode == "text":
        found = list(_ACTION.finditer(content)) if content else []
        if not found:
            raise LanguageModelError(
                "Expected an answer that ends with one line such as: Action: wait[5]", code="H3-LLM-014"
            )
        tool = _tool(found[-1][1], tools)
        given = _split(found[-1][2], tool)
    elif not calls:
        raise LanguageModelError("Expected a call of one tool, got none.", code="H3-LLM-015")
    else:
        function = calls[0]["function"]
        tool = _tool(function["name"], tools)
        try:
            given = msgspec.json.decode(function["arguments"] or "{}", type=dict[str, Any])
        except msgspec.MsgspecError:
            raise LanguageModelError(
                f"Expected the arguments of {tool.name} as a JSON object.", code="H3-LLM-016"
            ) from None
    return Call(tool.name, _checked(tool, given, names))


def kept(message: Mapping[str, Any]) -> dict[str, Any]:
    """Return the parts of a message that are used and recorded.

    They are its text, cut to `MOST_CONTENT` characters, and its first tool call.
    """
    content = message.get("content")
    found: dict[str, Any] = {"content": _clean(content)[:MOST_CONTENT] if isinstance(content, str) else ""}
    calls = message.get("tool_calls")
    first = calls[0] if isinstance(calls, list) and calls and isinstance(calls[0], dict) else {}
    function = first.get("function")
    if isinstance(function, dict) and isinstance(function.get("name"), str):
        arguments = function.get("arguments")
        if isinstance(arguments, dict):  # some endpoints do not write them as a text
            arguments = msgspec.json.encode(arguments).decode()
        text = _clean(arguments)[:MOST_CONTENT] if isinstance(arguments, str) else ""
        name = _clean(function["name"])[:64]
        found["tool_calls"] = [{"function": {"name": name, "arguments": text}}]
    return found


def _clean(text: str) -> str:
    """Return a text without halves of characters, which cannot be written."""
    return text.encode("utf-8", "replace").decode()


def _tool(name: str, tools: Sequence[Tool]) -> Tool:
    found = next((tool for tool in tools if tool.name == name), None)
    if found is None:
        raise LanguageModelError(
            f"There is no tool {name[:40]!r}.{suggest(name[:40], [tool.name for tool in tools])}", code="H3-LLM-017"
        )
    return found


def _split(text: str, tool: Tool) -> dict[str, Any]:
    """Return the arguments between brackets, in the order of the parameters; the last one may contain commas."""
    values = [value.strip() for value in text.split(",", max(len(tool.parameters) - 1, 0))] if text.strip() else []
    if len(values) > len(tool.parameters):
        raise LanguageModelError(f"{tool.name} takes no arguments, got {text[:60]!r}.", code="H3-LLM-018")
    return {p.name: value for p, value in zip(tool.parameters, values, strict=False) if value}


def _checked(tool: Tool, given: Mapping[str, Any], names: Names) -> dict[str, Any]:
    known = [p.name for p in tool.parameters]
    strange = [name for name in given if name not in known]
    missing = [p.name for p in tool.parameters if not p.optional and given.get(p.name) in (None, "")]
    if strange or missing:
        raise LanguageModelError(
            f"Expected {', '.join(known) or 'no arguments'} for {tool.name}; "
            + (f"{missing[0]} is missing." if missing else f"there is no {strange[0][:40]!r}."),
            code="H3-LLM-019",
        )
    return {
        p.name: _value(tool, p, given[p.name], names) for p in tool.parameters if given.get(p.name) not in (None, "")
    }


def _value(tool: Tool, parameter: Parameter, value: Any, names: Names) -> Any:
    known = names.of(parameter.kind)
    if parameter.kind == "seconds":
        text = str(value)
        if (
            isinstance(value, bool)
            or not re.fullmatch(r"\d{1,4}(\.\d*)?", text)
            or not 1 <= float(text) <= LONGEST_WAIT_S
        ):
            raise LanguageModelError(
                f"Expected {parameter.name} of {tool.name} from 1 to {LONGEST_WAIT_S}, got {text[:40]!r}.",
                code="H3-LLM-020",
            )
        return float(text)
    if not isinstance(value, str) or (parameter.kind == "text" and len(value) > LONGEST_MESSAGE):
        what = f"{len(value):,} characters" if isinstance(value, str) else type(value).__name__
        raise LanguageModelError(
            f"Expected {parameter.name} of {tool.name} as a text of up to {LONGEST_MESSAGE} characters, got {what}.",
            code="H3-LLM-021",
        )
    if parameter.kind != "text" and value not in known:
        raise LanguageModelError(
            f"There is no {value[:40]!r} for {parameter.name} of {tool.name}.{suggest(value[:40], known)}",
            code="H3-LLM-022",
        )
    return value
