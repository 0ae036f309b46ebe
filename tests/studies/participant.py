"""A scripted participant of a study, without a browser."""

from __future__ import annotations

import asyncio
from typing import Any

from tests.play.bot import Bot

DEVICE = {"webgl": True, "ping_ms": 3, "fps": 60, "width": 1280, "height": 720, "browser": "bot", "system": "Linux"}


class Participant(Bot):
    """Speaks the protocol of studies (docs/study.md); plays episodes by letting the server lead."""

    view: dict[str, Any]

    async def ask(self, path: str, body: dict[str, Any] | None = None) -> int:
        """Posts something; returns the HTTP status and keeps the view, or the text of a refusal."""
        async with self.http.post(self.link + path, json=body or {}) as answer:
            if answer.status == 200:
                self.view = await answer.json()
            else:
                self.told.append({"refused": await answer.text()})
            return answer.status

    @property
    def stage(self) -> dict[str, Any]:
        return self.view["stage"]

    async def join(self, **ids: str) -> None:
        """Consents and passes the check of the device."""
        await self.ask("api/study", {"ids": ids})
        if self.stage["kind"] == "consent":
            assert await self.ask("api/study/consent", {"accept": True, "hash": self.stage["hash"], "ids": ids}) == 200
        if self.stage["kind"] == "device":
            assert await self.ask("api/study/device", DEVICE) == 200

    async def fill(self) -> None:
        """Fills in the form that is next."""
        answers = {item["id"]: item["min"] for item in self.stage["items"] if item["kind"] != "text"}
        form = {name: self.stage[name] for name in ("form", "block", "trial")} | {"answers": answers}
        assert await self.ask("api/study/form", form) == 200

    async def begin(self) -> None:
        """Takes the seat of the episode that is next, and connects."""
        for _ in range(60):
            status = await self.sit()
            if status != 503:  # the machine that tests is busy
                break
            await asyncio.sleep(1.0)
        assert status == 200, self.told[-1]
        self.told.clear()
        self.states.clear()
        self.seq, self.acked, self.sent = 0, {}, {}
        await self.connect()
        await self.until(lambda: self.states)

    async def play(self) -> str:
        """Plays the episode that is next to its end; returns what ended it."""
        await self.begin()
        if self.stage["kind"] == "tutorial":
            await self.learn()
        for k, goal in enumerate(self.manifest["goals"]):
            for message in ({"k": "pick", "o": k, "lead": True}, {"k": "place", "p": goal["position"], "lead": True}):
                if self.states[-1][1] & 4:
                    break
                seq = await self.send(**message)
                await self.until(
                    lambda seq=seq: (
                        self.states[-1][1] & 4 or (self.states[-1][5] >= seq and not self.states[-1][1] & 8)
                    ),
                    60,
                )
        over = await self.until(lambda: self.heard("over"), 60)
        await self.ask("api/study")
        return over[0]["ended"]

    async def learn(self) -> None:
        """Walks to the ring of the tutorial, and turns until the thing has been looked at."""
        await self.until(lambda: self.heard("hud"))
        await self.send(k="goto", p=self.heard("hud")[-1]["marker"])
        await self.until(lambda: self.heard("hud")[-1]["marker"] is None, 60)
        await self.send(k="move", f=0, t=0.3)
        await self.until(lambda: self.heard("hud")[-1]["task"].startswith("Take"), 60)
        await self.send(k="move", f=0, t=0)

    async def go_on(self) -> list[str]:
        """Does everything up to the end; returns the kinds of stages."""
        kinds = []
        while self.stage["kind"] != "end":
            kinds.append(self.stage["kind"])
            if self.stage["kind"] == "form":
                await self.fill()
            else:
                await self.play()
        return kinds
