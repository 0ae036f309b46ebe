"""Who may sit down: by what a worker's games cost, and by how many seats a network address has."""

from __future__ import annotations

import asyncio
from pathlib import Path
from types import SimpleNamespace

import pytest
from aiohttp.test_utils import make_mocked_request
from aiohttp.web import HTTPServiceUnavailable

from h3data_viewers.hitl.bots.client import Client
from h3data_viewers.hitl.front import Front
from h3data_viewers.hitl.plan import PlayPlan
from h3data_viewers.hitl.workers import EXPECTED_SHARE, WorkerProcess
from tests.viewers.hitl.server import Server


def worker(busy: float, measured: int, games: int) -> WorkerProcess:
    found = WorkerProcess.__new__(WorkerProcess)
    found.busy, found.measured, found.games = busy, measured, {str(k) for k in range(games)}
    return found


@pytest.fixture
def front(tmp_path: Path) -> Front:
    plan = PlayPlan(app="rearrange", out=str(tmp_path), seats=("person",))

    async def made() -> Front:
        return Front(plan, tables=50, behind_proxy=True, seats_per_address=2)

    return asyncio.run(made())


@pytest.mark.parametrize(
    ("games", "expected"),
    [
        ((0.0, 0, 0), EXPECTED_SHARE),
        ((0.6, 10, 10), 0.66),
        ((0.6, 10, 12), 0.78),  # two have begun since it was measured
        ((0.03, 1, 1), 0.06),
    ],
)
def test_a_worker_knows_what_a_further_game_would_make(games: tuple[float, int, int], expected: float):
    assert worker(*games).with_one_more == pytest.approx(expected)


def test_a_worker_takes_games_up_to_a_share_of_a_core(front: Front):
    front.workers.active = [worker(0.69, 10, 10), worker(0.6, 10, 10)]
    front._require_capacity()
    front.workers.active = [worker(0.69, 10, 10), worker(0.65, 10, 10)]
    with pytest.raises(HTTPServiceUnavailable, match="Service Unavailable"):
        front._require_capacity()


def test_an_address_has_few_seats(front: Front):
    def request(forwarded: str) -> object:
        return make_mocked_request("POST", "/api/session", headers={"X-Forwarded-For": forwarded})

    for k, forwarded in enumerate(("1.1.1.1", "9.9.9.9, 1.1.1.1")):  # what a client claims stands first
        front._require_room_at(request(forwarded))  # type: ignore[arg-type]
        front._note_address(request(forwarded), front.journal.sit(f"t{k}", k, 0))  # type: ignore[arg-type]
    with pytest.raises(HTTPServiceUnavailable):
        front._require_room_at(request("1.1.1.1"))  # type: ignore[arg-type]
    front._require_room_at(request("2.2.2.2"))  # type: ignore[arg-type]
    game = front.journal.begin(0)
    front.journal.assign(next(iter(front.journal.seats.values())), game)
    front.journal.end(game, "success")
    front._require_room_at(request("1.1.1.1"))  # type: ignore[arg-type]
    front.behind_proxy = False
    assert front._address(SimpleNamespace(headers={"X-Forwarded-For": "1.1.1.1"}, remote="3.3.3.3")) == "3.3.3.3"  # type: ignore[arg-type]


async def five(link: str) -> list[int]:
    statuses = []
    clients = [Client(link) for _ in range(5)]
    for client in clients:
        await client.__aenter__()
        statuses.append(await client.sit())
    assert "network address" in clients[-1].told[-1]["refused"]
    assert await clients[0].sit() == 200, "who has a seat keeps it"
    for client in clients:
        await client.__aexit__()
    return statuses


@pytest.mark.slow
def test_the_server_refuses_a_fifth_seat_of_an_address_that_may_have_four(tmp_path: Path):
    options = {"tables": 20, "seats_per_address": 4}
    with Server(tmp_path / "rec", options, episodes=20, app="social_nav", partner="rollout_expert") as server:
        assert asyncio.run(five(server.links[0])) == [200, 200, 200, 200, 503]
