"""Command ``h3data train``, which trains policies of social navigation, skills of a robot, and rearrangement.

Social navigation and skills are learned from pictures, on a GPU or at a small scale on a CPU. Rearrangement is learned
with populations of partners, on CPU cores or in batched worlds on a device.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from h3data.commands.command import DryRunFlag, ForceFlag, JsonFlag, NameOf, Outcome
from h3data.commands.options import OfTasks, TaskNotes
from h3data.errors import InputError
from h3data.plugins import Registry
from h3data.progress import say
from h3data.render.light.sources import LightMode
from h3data.terminal import counted
from h3data_training.commands.folders import run_folder

if TYPE_CHECKING:
    from h3data_training.run import RunResult
    from h3data_training.settings import Settings
    from sim_kinematic.policies.visual_policy import VisualPolicy


@dataclass(frozen=True, kw_only=True)
class Trainer:
    """Trainer of policies for a task, which is an entry point of ``h3data.trainers`` with the name of the task."""

    run: Callable[[Train], Outcome]
    """Function that trains with the options of the command."""
    has_people: bool = True
    """True if there is a person in the task's episodes who walks by one of the sets of rules."""
    has_crowds: bool = False
    """True if there are several people in the task's episodes."""
    has_populations: bool = False
    """True if a robot is trained with a population of partners; False if one robot is trained by PPO on its
    observations.
    """
    recipes: str
    """Help text of ``--recipe`` for the task."""
    observations: str = ""
    """Help text of ``--observations`` for the task."""
    worlds: str = ""
    """Help text of ``--worlds`` for the task."""


TRAINERS: Registry[Trainer] = Registry("h3data.trainers", {}, what="task to train")
POPULATIONS = OfTasks(lambda task: TRAINERS.get(task).has_populations)
BY_PPO = OfTasks(lambda task: not TRAINERS.get(task).has_populations)
WITH_PEOPLE = OfTasks(lambda task: TRAINERS.get(task).has_people)
CROWDED = OfTasks(lambda task: TRAINERS.get(task).has_crowds)
FOLLOWING = OfTasks(lambda task: TRAINERS.get(task).has_people and not TRAINERS.get(task).has_populations)
RECIPES = TaskNotes(lambda task: TRAINERS.get(task).recipes)
OBSERVATIONS = TaskNotes(lambda task: TRAINERS.get(task).observations)
WORLDS = TaskNotes(lambda task: TRAINERS.get(task).worlds)


@dataclass(frozen=True)
class Train:
    """Train a policy and write its weights: social_nav from images, rearrange with a population, crowd_nav, or a skill.

    The weights can be used as a policy in every command: --policy weights:out/nav/policy.npz. The folder gets
    policy.npz, curve.parquet (the learning curve; also tensorboard/ if TensorBoard is installed) and checkpoint.pt,
    all updated every half minute. For rearrange, it also gets partner_0.npz, ... if partners learn. Ctrl-C or SIGTERM
    finishes the current update and saves; --resume continues the run.

    Examples:
        h3data train social_nav --recipe fast --device cuda -o out/nav
        h3data train social_nav --recipe fast --device cuda --minutes 17 --stop-after 8.7 --resume -o out/nav
        h3data train social_nav --recipe fast --device cuda --gpus 2 --warm-start end_to_end -o out/longer
        h3data train social_nav --recipe tiny -o out/tiny
        h3data train social_nav --observations humanoid_detector,humanoid_gps --device cuda -o out/blind
        h3data train social_nav --recipe fast --device cuda --scenes h3-homes/train,h3-homes-v2/train -o out/both
        h3data train social_nav --recipe fast --device cuda --observations arm_rgb --light baked --size 96x72 -o out/rgb
        h3data train social_nav --recipe fast --dry-run -o out/nav
        h3data train rearrange --population plan_pop_3 --minutes 30 -o out/plan_pop_3
        h3data train rearrange --recipe paper --population learn_pop --worlds 20 --device cuda -o out/paper
        h3data train rearrange --population plan_pop_3 --ablate humanoid_gps -o out/no_gps
        h3data train rearrange --population learn_pop --workers 16 --updates 200 --resume -o out/learn_pop
        h3data train crowd_nav -o out/crowd
        h3data train crowd_nav --recipe fast --device cuda --people 6 --minutes 10 -o out/crowd
        h3data train skill nav -o out/skills/nav
        h3data train skill pick --minutes 20 -o out/skills/pick
        h3data train skill place --recipe fast --device cuda -o out/seeing/place
        h3data train rearrange --population plan_pop_3 --pixels --worlds 2048 --device cuda -o out/plan_pop_3_pixels
        h3data train rearrange --population learn_single --worlds 1024 --device cuda -o out/learn_single
        h3data evaluate social_nav --policies weights:out/nav/policy.npz,rollout_expert -o out/table
    """

    task: Annotated[tyro.conf.Positional[str], NameOf(TRAINERS.names)]
    """Task to learn with the paper's rewards: social_nav (find a walking person and follow them), rearrange (help a
    person to bring two objects to their goals, by skills), or skill (one of these skills). Also crowd_nav (drive to a
    goal among people).
    """
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Folder of the run."""
    skill: tyro.conf.Positional[str] = ""
    """Skill to learn with the task skill: nav, pick or place."""
    population: Annotated[str | None, POPULATIONS] = None
    """Partners of the robot (paper section 4.2). learn_single (one person who also learns), plan_pop_1 to plan_pop_4
    (planners of one to four kinds), or learn_pop (eight people who learn, one in each episode) (default: plan_pop_3).
    """
    ablate: Annotated[tuple[str, ...], POPULATIONS] = ()
    """Ablations of the robot. humanoid_gps (it does not observe the person's position) or primitives (it cannot choose
    the four primitives of navigation).
    """
    recipe: Annotated[Literal["fast", "paper", "tiny"] | None, RECIPES] = None
    """Settings by name."""
    seed: int = 0
    """Seed of everything random."""
    minutes: float | None = None
    """Length of the run including set-up [minutes]; learning rate and horizon depend on it (default: 8.7, tiny 10,
    rearrange 30, skills 10, with fast 6, crowd_nav 10, with fast 6).
    """
    updates: int | None = None
    """Length of the run in updates instead of minutes, with which the same seed gives the same weights on a CPU."""
    stop_after: float | None = None
    """Time after which this call saves and stops [minutes]; --resume continues the run."""
    workers: Annotated[int | None, POPULATIONS] = None
    """Number of processes that play episodes, or with --worlds that prepare episodes (default: one for each core). The
    weights do not depend on it.
    """
    episodes_file: Annotated[Path | None, POPULATIONS] = None
    """File of the episodes to play, which is written with sampled episodes if it does not exist, so that several runs
    can share it (default: episodes.json.gz in the folder, with --worlds episodes.npz).
    """
    device: str = "cpu"
    """Device of the worlds and of learning: cpu, cuda or cuda:N. For rearrange without --worlds, it is the device of
    learning only.
    """
    scenes: tuple[str, ...] = ()
    """Homes to train in, named as for h3data generate; several sets are allowed (default: h3-homes/train)."""
    episodes_per_home: int | None = None
    """Number of training episodes in each home (default: 28, tiny 8, rearrange 32, skills 3, with fast 8, crowd_nav 4,
    with fast 24).
    """
    episodes_per_update: Annotated[int | None, POPULATIONS] = None
    """Number of episodes that --workers play between two updates (default: 32); more episodes keep more workers busy.
    """
    pixels: Annotated[bool, POPULATIONS] = False
    """Let the robot observe the depth of its arm's camera and the observations of the paper's robot, but no state
    (h3data docs populations).
    """
    observations: Annotated[tuple[str, ...], BY_PPO, OBSERVATIONS] = ()
    """Observations of the robot."""
    light: Annotated[LightMode | None, FOLLOWING] = None
    """Light in colours (arm_rgb): flat (equal everywhere) or baked (from windows, sun and lamps), which takes seconds
    for each new home. The policy's card records the light, and the policy observes it wherever it plays (default:
    flat).
    """
    size: Annotated[str | None, BY_PPO] = None
    """Size of the pictures that the robot observes [pixels], such as 96x72, with sides in multiples of 4 up to 1024.
    The policy's card records the size, and the policy observes it wherever it plays (default: 64x48, paper 224x171,
    tiny 32x24).
    """
    people: Annotated[int | None, CROWDED] = None
    """Number of people in each home, 0 to 12 (default: 4)."""
    worlds: Annotated[int | None, WORLDS] = None
    """Number of worlds that are stepped at once."""
    action_repeat: Annotated[int | None, BY_PPO] = None
    """Number of steps of 1/30 s for which an action is held (default: 3)."""
    robot: str | None = None
    """Body of the robot (default: quad_arm)."""
    rules: Annotated[Literal["natural", "paper", "both"] | None, WITH_PEOPLE] = None
    """Rules of the episodes as for h3data generate, or both (half of the episodes each) (default: natural; rearrange
    both).
    """
    gpus: Annotated[int, BY_PPO] = 1
    """Number of processes that train together, one for each GPU, each with its share of the worlds; on the CPU, the
    number of processes. In processes that torchrun starts, it is their number.
    """
    warm_start: Annotated[str | None, BY_PPO] = None
    """Trained policy to start with: weights:FILE or end_to_end. The critic is new and at first learns alone.
    Exploration is reduced, and the horizon of the value is longer from the start.
    """
    rollout: Annotated[int | None, BY_PPO] = None
    """Number of decisions per world between two updates, through which gradients of the recurrent state are propagated
    (default: 32, tiny 16).
    """
    minibatches: Annotated[int | None, BY_PPO] = None
    """Number of minibatches into which each rollout is divided (default: 4)."""
    follow_steps: Annotated[int | None, FOLLOWING] = None
    """Number of steps of following after which training episodes are cut short, so that they contain more finding
    (default: 0, never).
    """
    horizon: Annotated[float | None, BY_PPO] = None
    """Horizon of the value at the end of the run, in steps of 1/30 s; that at the start is in proportion (default: 500
    from 150, with --warm-start 750 from 500). A contact costs the rewards that would follow it, so a longer horizon
    makes a robot more careful.
    """
    resume: bool = False
    """Continue from the checkpoint in the folder, or start a run if there is none."""
    dry_run: DryRunFlag = False
    force: ForceFlag = False
    json: JsonFlag = False

    def run(self) -> Outcome:
        """Train the policy and return the path of its weights and its results."""
        if self.resume and self.force:
            raise InputError("Expected --resume (go on) or --force (begin anew), got both.", code="H3-TRAIN-009")
        if self.stop_after is not None and not self.stop_after > 0:
            raise InputError(
                f"Expected --stop-after of more than 0 minutes, got {self.stop_after}.", code="H3-TRAIN-010"
            )
        if self.skill and self.task != "skill":
            raise InputError(
                f"Expected the name of a skill after the task skill only, got {self.task} {self.skill}.",
                code="H3-TRAIN-011",
            )
        if self.task == "skill" and not self.skill:
            raise InputError(
                "Expected the name of a skill: h3data train skill nav, pick or place.", code="H3-TRAIN-012"
            )
        if self.task not in (known := TRAINERS.names()):
            raise InputError(
                f"Expected the task {', '.join(known[:-1])} or {known[-1]}, got {self.task!r}: policies of other tasks cannot "
                "be trained yet.",
                code="H3-TRAIN-013",
            )
        return TRAINERS.get(self.task).run(self)

    def _train_by_ppo(self) -> Outcome:
        from h3data_training.ranks import torchrun_place
        from h3data_training.run import describe, train

        name, settings = self._settings()
        first = None if self.warm_start is None else _first(self.warm_start)
        if first is not None:
            settings = settings.second_stage()
        if self.horizon is not None:
            settings = settings.looking_ahead(self.horizon)
        if self.dry_run:
            data = {"settings": settings.as_dict(), "out": str(self.out), **_cost(settings)}
            return Outcome(text=f"{describe(settings)}\n{_plan(settings)}\nNothing has been done.", data=data)
        beside = (torchrun_place() or (0, 1))[0] > 0  # the first process of several has claimed the folder
        folder = run_folder(
            self.out,
            force=self.force and not beside,
            resume=self.resume or beside,
            device=self.device,
            checkpoint_bytes=_cost(settings)["checkpoint_bytes"],
        )
        result = train(
            folder,
            settings,
            seed=self.seed,
            device=self.device,
            gpus=self.gpus,
            init=first,
            resume=self.resume,
            stop_after=self.stop_after,
            name=name,
            say=say,
        )
        return Outcome(text=_summary(result, settings.task), data=result.as_data(), result=result)

    def _settings(self) -> tuple[str, Settings]:
        """Return the recipe's name and the settings of social navigation, crowd navigation or a skill."""
        from h3data.replay.cameras import parse_size
        from h3data_training.crowds.settings import crowd_recipe
        from h3data_training.settings import recipe
        from h3data_training.skills.settings import skill_recipe

        changes: dict[str, Any] = {
            **self._length(),
            "scenes": self._scenes,
            "episodes_per_home": self.episodes_per_home,
            "worlds": self.worlds,
            "hold": self.action_repeat,
            "observations": self.observations or None,
            "robot": self.robot,
            "rollout": self.rollout,
            "minibatches": self.minibatches,
            "light": self.light,
            "picture_size": None if self.size is None else parse_size(self.size),
        }
        name = self.recipe or "tiny"
        if self.task == "skill":
            settings: Settings = skill_recipe(name, self.skill, **changes)
        elif TRAINERS.get(self.task).has_crowds:
            settings = crowd_recipe(name, self.task, **changes, people=self.people)
        else:
            settings = recipe(name, **changes, walk=self.rules, follow_steps=self.follow_steps)
        if self.size is not None and not settings.pictured:
            raise InputError(
                f"Expected an observation that needs a picture for pictures of {self.size}, got "
                f"{', '.join(settings.observations)}. Hint: --observations arm_depth,humanoid_detector,humanoid_gps.",
                code="H3-TRAIN-082",
            )
        return name, settings

    @property
    def _scenes(self) -> str | None:
        return ",".join(self.scenes) or None

    def _length(self) -> dict[str, Any]:
        """Return minutes and updates of the run, None as in the recipe; minutes alone replace a recipe's updates."""
        of_recipe = None if self.minutes is None else 0
        return {"minutes": self.minutes, "updates": of_recipe if self.updates is None else self.updates}

    def _train_in_populations(self) -> Outcome:
        if self.worlds is not None and self.worlds < 1:
            raise InputError(f"Expected at least 1 world, got --worlds {self.worlds}.", code="H3-TRAIN-017")
        if self.episodes_per_update is not None and self.episodes_per_update < 1:
            raise InputError(
                f"Expected at least 1 episode, got --episodes-per-update {self.episodes_per_update}.",
                code="H3-TRAIN-079",
            )
        if self.workers is not None and self.workers < 1:
            raise InputError(f"Expected at least 1 worker, got --workers {self.workers}.", code="H3-TRAIN-018")
        from h3data_training.commands.rearrangement import plan_rearrange, train_rearrange
        from h3data_training.populations.settings import rearrange_recipe

        settings = rearrange_recipe(
            self.recipe,
            **self._length(),
            population=self.population,
            scenes=self._scenes,
            episodes_per_home=self.episodes_per_home,
            robot=self.robot,
            walk=self.rules,
            without=self.ablate,
            pixels=self.pixels or None,
        )
        if self.worlds is not None:
            settings = settings.in_worlds(self.worlds)
        elif self.episodes_per_update is not None:
            settings = settings.in_updates_of(self.episodes_per_update)
        if self.dry_run:
            return plan_rearrange(self.out, settings, workers=self.workers)
        return train_rearrange(
            self.out,
            settings,
            seed=self.seed,
            workers=self.workers,
            device=self.device,
            resume=self.resume,
            force=self.force,
            stop_after=self.stop_after,
            episodes_file=self.episodes_file,
        )


def _first(name: str) -> VisualPolicy:
    """Return the trained policy of a name."""
    from sim_kinematic.policies.learned import is_learned, network_of
    from sim_kinematic.policies.visual_policy import VisualPolicy

    network = network_of(name) if is_learned(name) else None
    if not isinstance(network, VisualPolicy):
        raise InputError(
            f"Expected a policy of h3data train, as weights:FILE or end_to_end; got {name!r}.", code="H3-TRAIN-008"
        )
    return network


def _cost(settings: Settings) -> dict[str, int]:
    """Return sizes that decide whether a run fits on a machine [bytes]."""
    from sim_kinematic.policies.visual_policy import PICTURES

    s = settings
    pixels = s.picture_size[0] * s.picture_size[1] * sum(PICTURES.get(name, 0) for name in s.observations)
    # of the recurrent state; of weights with their moments
    state, weights = (4 * s.hidden, 110 << 20) if s.network == "resnet18_lstm" else (s.hidden, 20 << 20)
    return {
        "decisions_per_update": s.decisions_per_update,
        "rollout_bytes": s.decisions_per_update * (2 * pixels + 400),
        "checkpoint_bytes": s.worlds * (4 * pixels + 4 * state + 400) + weights,
    }


def _plan(settings: Settings) -> str:
    cost = _cost(settings)
    length = counted(settings.updates, "update") if settings.updates else f"{settings.minutes:g} minutes"
    return (
        f"{length}; {cost['decisions_per_update']} decisions an update, held for {counted(settings.hold, 'step')}; a rollout "
        f"takes {cost['rollout_bytes'] / 1e9:.2f} GB of device memory, a checkpoint {cost['checkpoint_bytes'] / 1e6:.0f} MB."
    )


def _summary(result: RunResult, task: str) -> str:
    from h3data_training.run import figures_of

    figures = figures_of(result.last).replace("  ", ", ") if result.last else "no update"
    lines = [
        f"{counted(result.updates, 'update')}, {result.decisions / 1e6:.2f} M decisions in {result.seconds / 60:.1f} minutes "
        f"(set-up {result.setup_s:.0f} s): {figures}.",
        f"Policy: {result.folder / 'policy.npz'}",
    ]
    if not result.done:
        lines.append("The run is not over. Hint: the same command with --resume goes on.")
    elif task.startswith("skill_"):
        lines.append(f"Hint: h3data evaluate skill --skills {result.folder / 'policy.npz'} -o table/")
    else:
        lines.append(f"Hint: h3data evaluate {task} --policies weights:{result.folder / 'policy.npz'} -o table/")
    return "\n".join(lines)


NAVIGATION = Trainer(
    run=Train._train_by_ppo,
    recipes="fast is for one GPU (4,096 worlds, 37 homes, pictures of 64 x 48), paper is the published one (pictures "
    "of 224 x 171, ResNet18 and LSTM, 200 M steps), tiny for a CPU (512 worlds, no pictures: the robot is told where the "
    "person is and how far off walls are; the default).",
    observations="arm_depth,humanoid_detector,humanoid_gps are the paper's and the default, of tiny "
    "humanoid_gps,range_scan; there are also arm_rgb in the place of arm_depth, egomotion, humanoid_velocity, "
    "way and range_scan.",
)
SKILLS = Trainer(
    run=Train._train_by_ppo,
    has_people=False,
    recipes="fast is for one GPU (4,096 worlds, pictures of 64 x 48, no map but for critic and teacher), tiny for a CPU "
    "(512 worlds, no pictures: the robot is told the path; the default).",
    observations="arm_depth, target_gps_compass, way, range_scan, egomotion, and of pick and place target_sensor, "
    "resting_sensor, arm_joints and is_holding (default: with fast arm_depth and what no map tells, else "
    "all but arm_depth).",
)
CROWDS = Trainer(
    run=Train._train_by_ppo,
    has_people=False,
    has_crowds=True,
    recipes="fast is for one GPU (4,096 worlds), tiny for a CPU (512 worlds, a smaller network; the default).",
    observations="goal_gps, goal_way (from the map: length and direction of the shortest path to the goal), people (the four "
    "nearest), range_scan, egomotion (default: all of them).",
)
HELPING = Trainer(
    run=Train._train_in_populations,
    has_populations=True,
    recipes="paper has the published settings but for pictures (100 M steps; h3data docs populations); the default "
    "is our own.",
    worlds="episodes of an update, with oracle skills and the paper's people, on --device (default: none; episodes "
    "have our full rules and are played by --workers).",
)
