"""Participants of a HITL session: pseudonyms in place of user ids, and the condition that a client announced."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from h3data.pseudonyms import anonymous_id, participant_key

USER_ID = "user_id"
_DEPTH = 64


def without_user_ids(document: Any, *, key: bytes | None = None, depth: int = 0) -> Any:
    """Return the JSON document with a pseudonym for each ``user_id``, at any depth up to 64.

    Args:
        document: JSON types.
        key: Secret key (default: `participant_key`, made only if there is a user id).
        depth: Level of nesting, counted by the function itself.
    """
    # deeper than any session, and far below what Python allows
    if depth > _DEPTH:
        return document
    if isinstance(document, list):
        return [without_user_ids(item, key=key, depth=depth + 1) for item in document]
    if not isinstance(document, dict):
        return document
    return {
        name: _pseudonym(value, key) if name == USER_ID else without_user_ids(value, key=key, depth=depth + 1)
        for name, value in document.items()
    }


def participation(
    users: Sequence[Any], agent_of_user: Mapping[Any, Any] | Any, people: Sequence[int]
) -> dict[str, Any]:
    """Return ``participant``, ``participants``, ``condition`` and ``experiment`` for `Episode.info`, as far as known.

    Args:
        users: The session's users, after `without_user_ids`.
        agent_of_user: Agent number by user index, as logged.
        people: Agent numbers of people.

    ``participants`` has the pseudonym of the user who controls each agent, by agent number. ``participant`` joins the
    pseudonyms of users who control people by ``+``, or of all users if nobody controls a person. ``condition`` is a
    parameter of that name in the address of the client's page (``...?user_id=7&condition=solo``), which habitat-hitl
    passes on in the connection record.
    """
    agents = agent_of_user if isinstance(agent_of_user, Mapping) else {}
    records = [_record(user) for user in users]
    names: dict[str, str] = {}
    for index, record in enumerate(records):
        if isinstance(record.get(USER_ID), str) and record[USER_ID]:
            # JSON has texts as keys; without a map user k drives agent k
            names[str(agents.get(str(index), index))] = record[USER_ID]
    drivers = [name for agent, name in names.items() if agent in set(map(str, people))] or list(names.values())
    facts: dict[str, Any] = {}
    if names:
        facts |= {"participant": "+".join(dict.fromkeys(drivers)), "participants": names}
    for key in ("condition", "experiment"):
        values = {
            str(record[key]) for record in records if isinstance(record.get(key), str | int) and record[key] != ""
        }
        # participants of one session may not agree, and then none of them is right
        if len(values) == 1:
            facts[key] = values.pop()
    return facts


def _record(user: Any) -> Mapping[str, Any]:
    record = user.get("connection_record") if isinstance(user, dict) else None
    return record if isinstance(record, dict) else {}


def _pseudonym(value: Any, key: bytes | None) -> Any:
    text = str(value).strip() if isinstance(value, str | int | float) else ""
    return anonymous_id(text, key=participant_key() if key is None else key) if text else value
