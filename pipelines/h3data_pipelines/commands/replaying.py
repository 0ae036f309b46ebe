"""Command ``h3data replay``, which simulates a recording again to check it, to continue it, or to try another policy."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from h3data.commands.command import ForceFlag, JsonFlag, Outcome, claim_file, open_episode
from h3data.errors import H3DataError, InputError
from h3data.progress import progress
from h3data.recording.finding import find_episodes


@dataclass(frozen=True)
class ReplayCommand:
    """Simulate the recorded actions again: compare every step, continue from any step, or swap the robot's policy.

    --verify names the first step, column and values that differ. --resume-from K keeps the first K steps and simulates the
    rest, under the episode's own policy or another. --counterfactual keeps people on their recorded tracks, without
    reactions, and lets another policy drive the robots. --added-time leaves the robots out. The command supports
    recordings of social_nav, rearrange and wander.

    Examples:
        h3data replay out/demo/episode.mcap --verify
        h3data replay ds/ --verify --json
        h3data replay ds/ --added-time
        h3data replay ds#3 --resume-from 200 -o again.mcap
        h3data replay episode.mcap --resume-from 200 --policy stand_still -o other.mcap
        h3data replay episode.mcap --counterfactual --policy random -o what_if.mcap
        h3data replay rearrange.mcap --resume-from 120 --policy greedy_nearest --partner object_2 -o other.mcap
    """

    recording: tyro.conf.Positional[Path]
    """An .mcap file or one episode of a dataset (ds#3); with --verify and --added-time also a dataset or a folder of .mcap
    files."""
    verify: bool = False
    """Compare the simulation with the recording, bit for bit."""
    resume_from: int | None = None
    """Number of steps to keep; the rest is simulated."""
    counterfactual: bool = False
    """Keep people on their recorded tracks while robots follow --policy, from --resume-from or from the start."""
    added_time: bool = False
    """Simulate people of crowds again without robots, and compute the delay that robots cause for each person [s]."""
    policies: tuple[str, ...] = ()
    """Policies of the robots in turn (default: those of the recording). h3data generate TASK --help lists them."""
    partners: tuple[str, ...] = ()
    """Policies of the people in turn, for rearrange, as for h3data generate (default: those of the recording)."""
    out: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """File of the new recording (.mcap)."""
    force: ForceFlag = False
    json: JsonFlag = False

    def run(self) -> Outcome:
        """Verify the recording, or write its continuation or counterfactual."""
        continues = self.resume_from is not None or self.counterfactual
        if self.verify + self.added_time + continues != 1:
            raise InputError(
                "Choose what to do: --verify, --added-time, or --resume-from K or --counterfactual or both.",
                code="H3-OPTION-049",
            )
        if self.verify or self.added_time:
            if self.policies or self.partners or self.out is not None:
                raise InputError(
                    "--verify and --added-time repeat the recording and write nothing: leave out --policy, --partner and -o.",
                    code="H3-OPTION-053",
                )
            return self._verify() if self.verify else self._added_time()
        return self._continue()

    def _verify(self) -> Outcome:
        from sim_kinematic.tasks.resume import verify

        rows: list[dict[str, Any]] = []
        for source in progress(find_episodes([self.recording]), desc="verify", unit="episode"):
            row: dict[str, Any] = {"recording": source.name}
            try:
                recording = source.read()
                row["steps"] = len(recording)
                result = verify(recording)
            except H3DataError as error:
                rows.append({**row, "equal": None, "reason": str(error), "code": error.code})
                continue
            difference = None if result.difference is None else vars(result.difference)
            version = recording.episode.schema_version
            rows.append({**row, "equal": result.equal, "difference": difference, "schema_version": version})
        if len(rows) == 1 and rows[0]["equal"] is None:
            name, reason = rows[0]["recording"], rows[0]["reason"]
            raise InputError(reason if name in reason else f"{reason} Recording: {name}", code=rows[0]["code"])
        equal = sum(row["equal"] is True for row in rows)
        lines = [_line(row) for row in rows]
        if len(rows) != 1:
            lines.append(f"{equal} of {len(rows)} recordings were reproduced bit for bit")
        data = {"recordings": len(rows), "equal": equal, "episodes": rows}
        return Outcome(text="\n".join(lines), data=data, exit_code=0 if equal == len(rows) else 1)

    def _added_time(self) -> Outcome:
        from h3data_pipelines.validation.added_time import added_time

        rows = [
            {"recording": source.name, **person._asdict()}
            for source in progress(find_episodes([self.recording]), desc="without robots", unit="episode")
            for person in added_time(source.read())
        ]
        known = [row["seconds"] for row in rows if row["seconds"] is not None]
        lines = [
            f"{row['recording']} {row['person']}: "
            + ("no goal to compare" if row["seconds"] is None else f"{row['seconds']:+.2f} s over {row['goals']} goals")
            for row in rows
        ]
        mean = sum(known) / len(known) if known else None
        if mean is not None:
            lines.append(f"added time of people: {mean:.2f} s on average of {len(known)} people")
        return Outcome(text="\n".join(lines), data={"people": rows, "mean_s": mean})

    def _continue(self) -> Outcome:
        from h3data.recording import write_mcap
        from sim_kinematic.tasks.resume import counterfactual, resume

        if self.out is None or self.out.suffix != ".mcap":
            raise InputError(f"Expected a .mcap file to write with -o, got {self.out or 'none'}.", code="H3-OPTION-050")
        if self.counterfactual and not self.policies:
            raise InputError("--counterfactual needs the other policy: --policy NAME.", code="H3-OPTION-051")
        if self.counterfactual and self.partners:
            raise InputError(
                "With --counterfactual people keep their tracks: leave out --partner.", code="H3-OPTION-052"
            )
        out = claim_file(self.out, force=self.force)
        old, step = open_episode(self.recording), self.resume_from or 0
        if self.counterfactual:
            new = counterfactual(old, ",".join(self.policies), step=step)
        else:
            new = resume(old, step, policy=",".join(self.policies) or None, partner=",".join(self.partners) or None)
        write_mcap(new, out, overwrite=self.force)
        info = new.episode.info
        then = f", then {info['policy']}" if info.get("policy") else ""
        beside = " beside the recorded person, who does not react" if self.counterfactual else ""
        ended = f"; ended by {info['ended']}" if "ended" in info else ""
        text = f"{out}: {len(new)} steps, the first {step} as recorded{then}{beside}{ended}"
        data = {
            "recording": str(out),
            "uid": new.episode.uid,
            "of": old.episode.uid,
            "steps": len(new),
            "kept": step,
            "policy": info.get("policy"),
            "ended": info.get("ended"),
            "human_reactive": info.get("human_reactive"),
        }
        return Outcome(text=text, data=data)


def _line(row: dict[str, Any]) -> str:
    if row["equal"] is None:
        return f"refused    {row['recording']}: {row['reason']}"
    if row["equal"]:
        return f"equal      {row['recording']}: {row['steps']} steps"
    d = row["difference"]
    old = row["schema_version"] == "1.0"
    hint = " (written with schema 1.0, which rounded actions after they had been applied)" if old else ""
    return (
        f"different  {row['recording']}: from step {d['step']}, first in {d['column']}: recorded {d['recorded']}, "
        f"simulated {d['simulated']}{hint}"
    )
