"""``h3data evaluate``: every robot, in rearrangement with every partner, over the same episodes, and the paper's numbers
beside."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from h3data.commands.command import AssetsOption, ForceFlag, JsonFlag, MissingFlag, Outcome, WalkOption
from h3data.commands.executors import ExecutorOption
from h3data.errors import InputError
from h3data.progress import progress
from h3data.render.light.sources import LightMode
from h3data_pipelines.jobs.evaluation_runs import EvaluationRequest, evaluate_task
from h3data_pipelines.jobs.evaluations import ALL
from h3data_pipelines.jobs.skill_evaluations import evaluate_skills


@dataclass(frozen=True)
class Evaluate:
    """Play policies in the same episodes and compare their metrics with the paper's.

    S, SPS, F, CR, BYR, TD and FD of social_nav; SR, RE, CR and RC with every partner of rearrange, with 95% intervals. Each
    episode is a small file in the output folder: an interrupted evaluation goes on where it was. skill: how often each learned
    skill succeeds, the robot alone.

    Examples:
        h3data evaluate rearrange --scenes h3-homes/test -o out/zsc
        h3data evaluate rearrange --policies complement,still --partners both,object_1 --episodes 20 -o out/pairs
        h3data evaluate social_nav --scenes h3-homes/test --workers 2 -o out/social_nav
        h3data evaluate social_nav --policies rollout_expert,weights:net.npz --episodes 20 -o out/mine
        h3data evaluate social_nav --policies "weights:out/s*/policy.npz,rollout_expert" -o out/seeds
        h3data evaluate rearrange --scenes medium --homes 2 --episodes 8 --workers 2 -o out/pairs
        h3data evaluate rearrange --episodes 20 --keep --zsc plan_pop_1 --zsc plan_pop_2 -o out/zsc
        h3data evaluate rearrange --episodes-file val.json.gz --assets data/ -o out/val
        h3data evaluate rearrange --policies plan_pop_3_robot --partners plan_pop_3 --skills learned -o out/learned
        h3data evaluate skill --skills out/skills -o out/table
        h3data report out/zsc
    """

    task: tyro.conf.Positional[str]
    """social_nav: find a walking person and follow them; rearrange: help them to bring two objects to their goals; skill: nav,
    pick and place, one by one."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Folder for the table (table.txt, table.json) and the results of each episode (episodes/)."""
    policies: str = ALL
    """Robots, separated by commas. social_nav: rollout_expert, heuristic_expert, sampling_expert, future_oracle,
    learned_follower, end_to_end, end_to_end_paper, random, stand_still or weights:FILE; rearrange: complement,
    greedy_nearest, same_object, still, and the learned learn_single, plan_pop_3_robot and learn_pop; or all.
    weights:out/s*/policy.npz, in quotes, stands for all files that fit: they are one row, the mean over training seeds and its
    standard deviation."""
    partners: str = ALL
    """rearrange: policies of the person, as --partner of h3data generate, separated by commas: plan_pop_1 to plan_pop_4,
    both, object_1, object_2, still, and the learned learn_single_partner_0 to _2 and learn_pop_partner_0 to _2; or all."""
    zsc: tuple[str, ...] = ()
    """rearrange: a partner of the population whose mean is shown (repeatable; default: the paper's four planners, both,
    object_1, object_2 and still, if all play, and the ten of these and the learned ones, if they do)."""
    scenes: str = "h3-homes/test"
    """As of h3data generate."""
    episodes_file: Path | None = None
    """Episode file instead of --scenes, as of h3data generate: one of ours, in rearrange also Habitat's or PARTNR's."""
    assets: AssetsOption = ()
    allow_missing: MissingFlag = False
    episodes: int | None = None
    """How many (default: all of a set, else 10)."""
    homes: int = 4
    """Number of different homes of a preset that the episodes go round."""
    seed: int = 0
    """Everything random follows from it."""
    robot: str | None = None
    """Body of the robot, as of h3data generate (default: that of the episode, else quad_arm)."""
    human: str | None = None
    """Body of the person: a built-in one, with an outfit as in female_0:dress; any: each episode samples one of the twelve
    adults; random: each makes one (default: female_0)."""
    motion: Path | None = None
    """How people walk, as of h3data generate."""
    human_walk: WalkOption | None = None
    """How people walk: natural walks curves at 1.3 m/s, sets off and brakes; paper turns on the spot and is at 2.5 m/s at
    once (default: the episode's, else natural)."""
    human_speed: float | None = None
    """Walking speed of the person [m/s] (default: that of --human-walk)."""
    max_steps: int | None = None
    """Length limit of an episode (default: 1500)."""
    skills: str = ""
    """rearrange and skill: learned skills of robots: learned (those that come with the package), a folder of training runs, or
    policy files of h3data train skill, separated by commas (default: none in rearrange, learned for skill). In rearrange also
    oracle, as of h3data generate."""
    light: LightMode | None = None
    """Light in the colours that policies are shown: baked, from windows, sun and lamps, or flat, the same everywhere (default:
    the light that each has learned in). Those that see no colours play as ever."""
    workers: int = 1
    """Processes."""
    executor: ExecutorOption = "local"
    keep: bool = False
    """Keep the recordings, as datasets in OUT/recordings, for h3data report, view and rerender."""
    resume: bool = False
    """Go on with an evaluation of the same options, which must be there. Without this, one that is there is gone on with
    too."""
    force: ForceFlag = False
    json: JsonFlag = False

    def run(self) -> Outcome:
        is_skill = self.task == "skill"
        if is_skill and self.robot is not None:
            raise InputError("Learned skills are for the robot that they were trained with: leave out --robot.")
        if is_skill and (self.keep or self.zsc or self.policies != ALL or self.partners != ALL):
            raise InputError("Skills are judged with the robot alone: no --policies, --partners, --zsc or --keep.")
        if is_skill and self.light is not None:
            raise InputError("Skills see depth, to which light makes no difference. Hint: leave out --light.")
        request = EvaluationRequest(
            task="rearrange" if is_skill else self.task,
            policies="still" if is_skill else self.policies,
            partners="still" if is_skill else self.partners,
            zsc=self.zsc,
            scenes=self.scenes,
            episodes_file=self.episodes_file,
            assets=self.assets,
            allow_missing=self.allow_missing,
            episodes=self.episodes,
            homes=self.homes,
            seed=self.seed,
            robot=self.robot,
            human=self.human,
            motion=None if self.motion is None else str(self.motion),
            human_walk=self.human_walk,
            human_speed=self.human_speed,
            max_steps=self.max_steps,
            skills=self.skills or ("learned" if is_skill else ""),
            light=self.light,
        )
        if is_skill:
            judged = evaluate_skills(
                request, self.out, resume=self.resume, force=self.force, workers=self.workers, executor=self.executor,
                progress=progress,
            )  # fmt: skip
            text, code = judged.to_text(), 1 if judged.failed else 0
            return Outcome(text=text, data=judged.to_dict(), result=judged, exit_code=code)
        result = evaluate_task(
            request, self.out, keep=self.keep, resume=self.resume, force=self.force, workers=self.workers,
            executor=self.executor, progress=progress,
        )  # fmt: skip
        return Outcome(
            text=result.to_text(),
            data=result.to_dict(),
            result=result,
            exit_code=1 if result.failed or result.left_out else 0,
        )
