"""Command ``h3data evaluate``, which compares policies in the same episodes with each other and with the paper's numbers.

In rearrangement every robot policy plays with every partner.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from h3data.commands.arguments import result_of
from h3data.commands.command import (
    AssetsOption,
    ForceFlag,
    JsonFlag,
    MissingFlag,
    NameOf,
    Observe,
    ObserveOption,
    Outcome,
    OverridesOption,
    RuleSet,
    RuleSetOption,
    read_overrides,
)
from h3data.commands.executors import ExecutorOption
from h3data.commands.options import command_of
from h3data.errors import suggest_keywords
from h3data.progress import progress
from h3data.render.light.sources import LightMode
from h3data_pipelines.jobs.evaluation_runs import EvaluationRequest, evaluate_task
from h3data_pipelines.jobs.skill_evaluations import evaluate_skills
from h3data_pipelines.task_options import PLAYED, SKILL, WITH_SKILLS, of_tasks, policies_of, task_names, task_notes

if TYPE_CHECKING:
    from h3data.commands.arguments import FilePath, Paths
    from h3data_pipelines.arguments import Body, Overrides, Policies, Scenes, TaskChoice
    from h3data_pipelines.jobs.evaluation_runs import EvaluationResult
    from h3data_pipelines.jobs.skill_evaluations import SkillEvaluationResult

EVALUATED = NameOf(lambda: (*task_names(), SKILL))
WITH_PARTNERS = of_tasks(lambda task: task.usage.crosses_partners)
WITH_SKILLS_OR_ONE = of_tasks(lambda task: task.control.has_skills, SKILL)
SKILLS = task_notes(lambda task: "default none; also oracle, as of h3data generate.", skill="default learned.")


@suggest_keywords
def evaluate(
    task: TaskChoice,
    out: FilePath,
    *,
    policies: Policies = "all",
    partners: Policies = "all",
    unseen_partners: Policies = (),
    skills: Paths = (),
    card: str | None = None,
    observe: Observe | None = None,
    overrides: Overrides = (),
    scenes: Scenes = "h3-homes/test",
    episodes_file: FilePath | None = None,
    assets: Paths = (),
    allow_missing: bool = False,
    episodes: int | None = None,
    homes: int = 4,
    seed: int = 0,
    robot: Body | None = None,
    human: FilePath | None = None,
    motion: FilePath | None = None,
    rules: RuleSet | None = None,
    human_speed: float | None = None,
    max_steps: int | None = None,
    light: LightMode | None = None,
    workers: int = 1,
    executor: str = "local",
    save_recordings: bool = False,
    resume: bool = False,
    force: bool = False,
) -> EvaluationResult | SkillEvaluationResult:
    """Play policies in the same episodes and measure them: ``evaluate("social_nav", "out", policies=["end_to_end", Mine])``.

    ``h3data evaluate TASK --help`` explains the options, which have the same names there.

    Returns:
        The table of policies (and partners) with 95% intervals, and the failed episodes; for the task ``skill``, the
            table of the skills.

    Raises:
        InputError: an option is invalid, or the folder holds results with other options.
    """
    return result_of(Evaluate, locals())


@command_of(evaluate)
class Evaluate:
    """Play policies in the same episodes and compare their metrics with the paper's.

    The table has S, SPS, F, CR, BYR, TD and FD of social_nav, or SR, RE, CR and RC of rearrange with every partner,
    with 95% intervals. For skill, it has the success rate of each learned skill with the robot alone. Each episode is a
    small file in the output folder, so that an interrupted evaluation continues where it was.

    Examples:
        h3data evaluate rearrange --scenes h3-homes/test -o out/zsc
        h3data evaluate rearrange --policies complement,still --partners both,object_1 --episodes 20 -o out/pairs
        h3data evaluate social_nav --scenes h3-homes/test --workers 2 -o out/social_nav
        h3data evaluate social_nav --policies rollout_expert,weights:net.npz --episodes 20 -o out/mine
        h3data evaluate social_nav --policies "weights:out/s*/policy.npz,rollout_expert" -o out/seeds
        h3data evaluate rearrange --scenes medium --homes 2 --episodes 8 --workers 2 -o out/pairs
        h3data evaluate rearrange --episodes 20 --save-recordings --unseen-partners plan_pop_1,plan_pop_2 -o out/zsc
        h3data evaluate rearrange --episodes-file val.json.gz --assets data/ -o out/val
        h3data evaluate rearrange --policies plan_pop_3_robot --partners plan_pop_3 --skills learned -o out/learned
        h3data evaluate skill --skills out/skills -o out/table
        h3data report out/zsc
    """

    task: Annotated[tyro.conf.Positional[str], EVALUATED]
    """social_nav: find a walking person and follow them. rearrange: help them to bring two objects to their goals. skill: nav,
    pick and place, one by one."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Folder for the table (table.txt, table.json) and the results of each episode (episodes/)."""
    policies: Annotated[tuple[str, ...], PLAYED, policies_of("robot", default=False)]
    """Policies of the robot: names as for h3data generate, or all. A pattern in quotes such as "weights:out/s*/policy.npz"
    stands for all matching files; they share one row with the mean and standard deviation over training seeds."""
    partners: Annotated[tuple[str, ...], PLAYED, policies_of("human", default=False)]
    """Policies of the person, or all."""
    unseen_partners: Annotated[tuple[str, ...], WITH_PARTNERS]
    """Partners that no robot was trained with, whose mean is shown as the zero-shot column (default: the paper's four
    planners, both, object_1, object_2 and still, if all of them play, and the ten partners that also include the
    learned ones, if all of these play).
    """
    scenes: tuple[str, ...]
    """Scenes, as for h3data generate."""
    episodes_file: Path | None
    """Episode file instead of --scenes, as for h3data generate: a file of h3data, or for rearrange also of Habitat or
    PARTNR.
    """
    assets: AssetsOption
    allow_missing: MissingFlag
    episodes: int | None
    """Number of episodes (default: all of a set or file, else 10)."""
    homes: int
    """Number of different homes of a preset; the episodes use them in turn."""
    seed: int
    """Seed of everything random."""
    robot: Annotated[str | None, PLAYED]
    """Body of the robot, as for h3data generate (default: that of the episode, else quad_arm)."""
    human: str | None
    """Body of the person: a built-in body, optionally with an outfit as in female_0:dress; any (each episode samples
    one of the twelve adults); or random (each episode has a new person) (default: female_0).
    """
    motion: Path | None
    """Motion file with the gait of people, as for h3data generate."""
    rules: RuleSetOption
    human_speed: float | None
    """Walking speed of the person [m/s] (default: that of --rules)."""
    max_steps: int | None
    """Largest number of steps of an episode (default: 1500)."""
    skills: Annotated[tuple[str, ...], WITH_SKILLS_OR_ONE, SKILLS]
    """Learned skills of robots: learned (the pretrained skills of the package), a folder of training runs, or policy
    files of h3data train skill.
    """
    card: str | None
    """Cards of the task scenarios (h3data docs scenarios): one, several separated by commas, or all."""
    observe: Annotated[ObserveOption, WITH_SKILLS]
    overrides: OverridesOption
    light: Annotated[LightMode | None, PLAYED]
    """Light in the colours that policies observe: baked (from windows, sun and lamps) or flat (equal everywhere)
    (default: the light in which each policy was trained). It does not affect policies that observe no colours.
    """
    workers: int
    """Number of worker processes."""
    executor: ExecutorOption
    save_recordings: Annotated[bool, PLAYED]
    """Save the recordings, as datasets in OUT/recordings, for h3data report, view and rerender."""
    resume: bool
    """Continue an evaluation that was started with the same options, and fail if there is none. Without this option, an
    existing one is continued too."""
    force: ForceFlag
    json: JsonFlag = False

    def run(self) -> Outcome:
        """Play all episodes and return the table of metrics."""
        from sim_kinematic.tasks.rearrange.task import Rearrange

        is_skill = self.task == SKILL  # skills are judged in episodes of rearrangement
        request = EvaluationRequest(
            task=Rearrange.name if is_skill else self.task,
            policies=("still",) if is_skill else self.policies,
            partners=("still",) if is_skill else self.partners,
            unseen_partners=self.unseen_partners,
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
            rules=self.rules,
            human_speed=self.human_speed,
            max_steps=self.max_steps,
            skills=",".join(self.skills) or ("learned" if is_skill else ""),
            overrides=read_overrides(self.overrides, card=self.card, observe=self.observe),
            light=self.light,
        )
        if is_skill:
            judged = evaluate_skills(
                request,
                self.out,
                resume=self.resume,
                force=self.force,
                workers=self.workers,
                executor=self.executor,
                progress=progress,
            )
            text, code = judged.to_text(), 1 if judged.failed else 0
            return Outcome(text=text, data=judged.to_dict(), result=judged, exit_code=code)
        result = evaluate_task(
            request,
            self.out,
            save_recordings=self.save_recordings,
            resume=self.resume,
            force=self.force,
            workers=self.workers,
            executor=self.executor,
            progress=progress,
        )
        return Outcome(
            text=result.to_text(),
            data=result.to_dict(),
            result=result,
            exit_code=1 if result.failed or result.left_out else 0,
        )
