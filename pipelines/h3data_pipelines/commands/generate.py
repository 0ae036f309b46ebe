"""Command ``h3data generate``, which simulates episodes into datasets and can be interrupted and resumed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from h3data.commands.arguments import result_of
from h3data.commands.command import (
    AssetsOption,
    BackendOption,
    DryRunFlag,
    ForceFlag,
    JsonFlag,
    LightOption,
    MissingFlag,
    NameOf,
    Observe,
    ObserveOption,
    Outcome,
    OverridesOption,
    PeopleOption,
    RuleSet,
    RuleSetOption,
    ShareScenesFlag,
    claim_folder,
    keeping,
    read_overrides,
)
from h3data.commands.executors import Executor, ExecutorOption, check_workers, opened
from h3data.commands.options import command_line, command_of
from h3data.errors import H3DataError, InputError, JobStopError, suggest_keywords
from h3data.progress import progress
from h3data.recording.storage import AnyPath, place
from h3data.scene.scene_sets import find_scene_set
from h3data.terminal import counted
from h3data_pipelines.dataset_folders import remove_dataset, unfinished_dataset, uninterrupted
from h3data_pipelines.hub.provenance import write_commands
from h3data_pipelines.jobs.episode_files import (
    FileJobs,
    claim_episode_file,
    notes_on,
    requested_jobs,
    save_episodes,
    widest_episodes,
)
from h3data_pipelines.jobs.episodes import (
    Choices,
    Job,
    check_numbers,
    most_steps,
    refuse_beside,
    scenes_of,
    with_skills,
)
from h3data_pipelines.jobs.failed_episodes import beside, is_failed, stopped_job
from h3data_pipelines.jobs.generated import Generated, WrittenDataset, first_played, require_same_options, whose
from h3data_pipelines.jobs.running import RenderedVideo, VideoJob, film_jobs
from h3data_pipelines.outputs import check_backend
from h3data_pipelines.task_options import WITH_SKILLS, policies_of, task_names, task_notes

if TYPE_CHECKING:
    from typing import Literal

    from h3data.bodies.people.rigid_parts import PeopleStyle
    from h3data.commands.arguments import FilePath, Paths
    from h3data.recording import DatasetWriter
    from h3data.render.light.sources import LightMode
    from h3data_pipelines.arguments import Agents, Body, Overrides, Policies, Scenes, TaskChoice

COMMIT_STEPS = 30_000
"""Number of steps after which episodes are committed; if the process is killed, about a minute of one core's work is
lost. It is not a time, because the files of a dataset must not depend on the speed of the machine.
"""
FRAME_STEPS = 4
"""Number of steps that one frame of a video counts as, in the work between two commits."""
MAX_STEPS = task_notes(lambda task: f"{(task.usage.dataset_rules or task.Spec()).max_steps}.")
SPAWN_DISTANCE = task_notes(lambda task: "Sets and files decide it." if task.usage.set_rules else "")


@suggest_keywords
def generate(
    task: TaskChoice,
    out: FilePath,
    *,
    episodes: int | None = None,
    seed: int = 0,
    scenes: Scenes = "small",
    episodes_file: FilePath | None = None,
    save_episodes: FilePath | None = None,
    assets: Paths = (),
    allow_missing: bool = False,
    homes: int = 4,
    policies: Policies = (),
    partners: Policies = (),
    skills: Paths = (),
    agents: Agents = (),
    robot: Body | None = None,
    human: FilePath | None = None,
    motion: FilePath | None = None,
    rules: RuleSet | None = None,
    human_speed: float | None = None,
    max_steps: int | None = None,
    spawn_distance: float | None = None,
    card: str | None = None,
    observe: Observe | None = None,
    overrides: Overrides = (),
    sensors: Sequence[str] = (),
    cameras: Paths = (),
    people: PeopleStyle = "skin",
    light: LightMode = "baked",
    backend: Literal["auto", "cpu", "gpu"] = "cpu",
    workers: int = 1,
    executor: str = "local",
    mcap: bool = False,
    share_scenes: bool = False,
    resume: bool = False,
    force: bool = False,
) -> Generated:
    """Simulate episodes of a task into a dataset: ``generate("social_nav", "ds", episodes=20, cameras=["robot_arm"])``.

    ``h3data generate TASK --help`` and h3data docs generate explain the options, which have the same names there.
    With ``workers`` above 1, call the function under ``if __name__ == "__main__":``, as Python's `multiprocessing`
    requires.

    Returns:
        The dataset, the failed episodes and the metrics.

    Raises:
        InputError: an option is invalid, or the folder is not empty.
    """
    return result_of(Generate, locals())


@command_of(generate)
class Generate:
    """Simulate episodes into a Parquet dataset (LeRobot v3 layout). The same seed gives the same episodes, bit for bit.

    Finished episodes survive Ctrl-C and kill, and the same command with --resume continues. An episode that cannot be
    played is listed at the end with its seed and error (exit code 1); the other episodes are played nevertheless.

    Examples:
        h3data generate social_nav --episodes 20 --seed 7 -o ds/
        h3data generate social_nav --scenes medium --homes 8 --episodes 200 --workers 2 -o ds/
        h3data generate social_nav --scenes h3-homes/test --human any -o ds/
        h3data generate social_nav --scenes h3-homes/train --episodes 1000 --workers 2 -o ds/
        h3data generate social_nav --episodes-file exports/episodes/social_nav_h3-homes_test.json.gz -o ds/
        h3data generate social_nav --scenes h3-homes/test --policy weights:net.npz -o ds/
        h3data generate social_nav --scenes my_home.scene_instance.json --episodes 5 -o ds/ --mcap
        h3data generate rearrange --scenes h3-homes/test --policy complement --partner plan_pop_2 -o ds/
        h3data generate rearrange --agents robot,robot --policy complement,both -o ds/
        h3data generate rearrange --set objects=3 --skills learned -o ds/
        h3data generate rearrange --scenes h3-homes/test --save-episodes test.json.gz --dry-run -o ds/
        h3data generate rearrange --episodes-file val/social_rearrange.json.gz --assets data/ -o ds/
        h3data generate social_nav --episodes 20 --cameras robot_arm,human_head -o ds/
        h3data generate wander --agents robot,human,human --human any --episodes 50 --workers 2 -o ds/
        h3data generate wander --scenes h3-homes/test --agents robot,lift_arm,female_1 --max-steps 900 --mcap -o ds/
    """

    task: Annotated[tyro.conf.Positional[str], NameOf(task_names)]
    """Task to play: social_nav (find a walking person and follow them at 1-2 m), rearrange (help a person to bring two
    objects to their goals), wander (robots and people move between random points), an installed task, or module:Class
    (h3data docs extending).
    """
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Folder of the dataset, or its URI: s3://bucket/ds."""
    episodes: int | None
    """Number of episodes (default: all of a set or file, else 10)."""
    seed: int
    """Seed of everything random. With a scene set, 0 gives the set's own episodes, and any other seed gives new
    episodes in its scenes.
    """
    scenes: tuple[str, ...]
    """small, medium or large (built-in homes), one home as small:3, a set (h3-homes/train, /val, /test, or a .toml file), one
    of its scenes as h3-homes/test#3, or the path of a scene (.scene_instance.json, .glb). Several scenes are used in
    turn.
    """
    episodes_file: Path | None
    """Episode file (.json.gz, .json, .pickle) instead of --scenes: a file of h3data (--save-episodes, h3data scenes
    export), or in rearrange also of Habitat or PARTNR, whose starts are sampled from --seed.
    """
    save_episodes: Path | None
    """Also write the episodes to this file (.json.gz or .json), for --episodes-file; with --dry-run, write only this
    file.
    """
    assets: AssetsOption
    allow_missing: MissingFlag
    homes: int
    """Number of different homes of a preset; the episodes use them in turn."""
    policies: Annotated[tuple[str, ...], policies_of("robot")]
    """Policies of the robots in turn: each a name, weights:FILE (h3data docs learned-policies) or module:name."""
    partners: Annotated[tuple[str, ...], policies_of("human")]
    """Policy of the person, or policies of the people in turn."""
    agents: tuple[str, ...]
    """Agents of the episode (default: robot,human): kinds, bodies, files, or a kind with one of these, as in
    robot,human,male_1 or robot:my_robot.urdf,human:male_1."""
    robot: str | None
    """Body of each agent named robot: a built-in body, a URDF or MJCF file, or a folder with robot.toml (default:
    quad_arm).
    """
    human: str | None
    """Body of each agent named human: a built-in body, optionally with an outfit as in female_0:dress; random:SEED; an
    .npz file; any (each episode samples one of the twelve adults); or random (each episode has new people, in wander
    one body for each person) (default: the episode's body, else female_0).
    """
    motion: Path | None
    """Motion file with the gait of people: a file of h3data motion import, AMASS, Habitat or BVH (h3data docs motion).
    The motion is stored in each recording.
    """
    rules: RuleSetOption
    human_speed: float | None
    """Walking speed of the person [m/s] (default: the episode's speed, else that of --rules)."""
    max_steps: Annotated[int | None, MAX_STEPS]
    """Largest number of steps of an episode, at 30 steps per second (default: the episode's limit, else the task's)."""
    spawn_distance: Annotated[float | None, SPAWN_DISTANCE]
    """Smallest distance between any two agents at the start [m] (default: 5, as in the paper's evaluation)."""
    skills: Annotated[tuple[str, ...], WITH_SKILLS]
    """Skills of the robots: learned (the pretrained skills of the package), a folder of training runs, policy files of
    h3data train skill, or oracle: simple rules that also run on a GPU, with people as in the paper and nobody giving
    way (default: skills that know the whole state).
    """
    card: str | None
    """Cards of the task scenarios (h3data docs scenarios): one, several separated by commas, or all."""
    observe: Annotated[ObserveOption, WITH_SKILLS]
    overrides: OverridesOption
    sensors: tuple[str, ...]
    """Sensors of robots that are recorded with every step: lidar, lidar_3d or any other sensor in h3data docs
    environments that is not an image; not in rearrange.
    """
    cameras: tuple[str, ...]
    """Cameras whose videos are added to the dataset (observation.images.<name>), as in rerender."""
    people: PeopleOption
    light: LightOption
    """Light of the videos: baked (from windows, sun and lamps) or flat (equal everywhere). Policies that observe
    colours get the light in which they were trained.
    """
    backend: BackendOption
    workers: int
    """Number of worker processes."""
    executor: ExecutorOption
    mcap: bool
    """Also write each episode as <out>/mcap/<episode>.mcap, at the end."""
    share_scenes: ShareScenesFlag
    resume: bool
    """Continue an interrupted dataset that was started with the same options."""
    dry_run: DryRunFlag = False
    force: ForceFlag
    json: JsonFlag = False

    def run(self) -> Outcome:
        """Simulate the episodes and return their number and the dataset's size."""
        from h3data.metrics import measure_many
        from h3data.recording import Dataset, DatasetWriter

        if self.force and self.resume:
            raise InputError("Choose one: --resume goes on with a dataset, --force replaces it.", code="H3-OPTION-038")
        if self.share_scenes and not self.mcap:
            raise InputError(
                "--share-scenes is for logs (--mcap): a dataset stores each scene once anyway.", code="H3-OPTION-039"
            )
        if self.cameras and self.executor == "local":
            check_backend(self.backend)
        out = place(self.out)
        if self.save_episodes is not None:
            claim_episode_file(self.save_episodes, force=self.force or self.resume)
        asked = self._jobs()
        jobs = asked.jobs
        if self.save_episodes is not None:
            unsaved = save_episodes(jobs, self.save_episodes)
            asked = asked._replace(left_out=(*asked.left_out, *unsaved))
        if self.dry_run:
            return self._plan(asked)
        with opened(self.executor, self.workers) as executor:
            if self.force:
                remove_dataset(out)
            if self.resume:
                require_same_options(out, jobs, cameras=self.cameras)
            else:
                claim_folder(out, force=False, unfinished=lambda: unfinished_dataset(out))
            like = widest_episodes(jobs)  # read only by a new dataset
            with keeping(lambda: _kept(out)), DatasetWriter(out, resume=self.resume, like=like) as writer:
                done = len(writer)
                self._simulate(jobs[done:], writer, executor)
        write_commands(out, [command_line("generate", self)])
        written = WrittenDataset(
            Dataset(out), out / "mcap" if self.mcap else None, share_in=out if self.share_scenes else None
        )
        table = measure_many(r for r in written if not is_failed(r))
        text = f"{counted(len(written), 'episode')}{whose(jobs[0])}, {counted(written.steps, 'step')} in {out}"
        text += f"\n\n{table.to_text()}"
        if cameras := written.dataset.cameras:
            text += f"\nvideos of {', '.join(cameras)}"
        text += "".join(f"\nfailed {line}" for line in written.failed) + notes_on(asked)
        data: dict[str, Any] = {
            "dataset": str(out),
            "cameras": list(cameras),
            "episodes": len(written),
            "new": len(written) - done,
            "steps": written.steps,
            "state_hashes": written.hashes,
            "failed": written.failed,
            "left_out": list(asked.left_out),
            "warnings": list(asked.warnings),
            "metrics": table.to_dict(),
        }
        result = Generated(written.dataset, len(written) - done, tuple(written.failed), table, asked.left_out)
        return Outcome(text=text, data=data, result=result, exit_code=1 if written.failed or asked.left_out else 0)

    def _plan(self, asked: FileJobs) -> Outcome:
        """Describe the episodes that would be played, without playing any."""
        jobs = asked.jobs
        scenes = scenes_of(jobs)
        named = ", ".join(scenes[:6]) + (f" and {len(scenes) - 6} more" if len(scenes) > 6 else "")
        plan: dict[str, Any] = {
            "task": self.task,
            "episodes": len(jobs),
            "scenes": scenes,
            "policy": jobs[0].policy or "the task's default",
            "partner": jobs[0].partner or "the task's default",
            "most_steps": most_steps(jobs),
            "cameras": list(self.cameras),
            "workers": self.workers,
            "out": str(self.out),
        }
        text = (
            f"Would play {counted(len(jobs), 'episode')} of {self.task}{whose(jobs[0])} into {self.out}: "
            f"{plan['most_steps']:,} steps at most, in {self.workers} process{'es' if self.workers != 1 else ''}, "
            f"in {counted(len(scenes), 'scene')}: {named}"
        )
        if self.cameras:
            text += f"; with videos of {', '.join(self.cameras)}"
        if self.save_episodes is not None:
            plan["saved_episodes"] = str(self.save_episodes)
            text += f"\nWrote the episodes to {self.save_episodes}"
        plan |= {"left_out": list(asked.left_out), "warnings": list(asked.warnings)}
        return Outcome(text=text + notes_on(asked), data={"plan": plan}, exit_code=1 if asked.left_out else 0)

    def _simulate(self, jobs: Sequence[Job], writer: DatasetWriter, executor: Executor) -> None:
        """Play the jobs into a dataset. Failed ones wait for one that was played, which says what columns there are."""
        played = first_played(writer)
        if played is not None and self.cameras and (light := played.episode.info.get("light", "flat")) != self.light:
            raise InputError(
                f"The videos of {self.out} are in {light} light, as --light {light} makes them.", code="H3-OPTION-040"
            )
        backend = self.backend
        if played is not None and self.cameras:
            # of one back end all: `auto` goes on with the one that it found
            backend = played.episode.info.get("backend", "cpu")
            if self.backend not in ("auto", backend):
                raise InputError(
                    f"The videos of {self.out} are those of the back end {backend}. Hint: --backend {backend}, or another -o.",
                    code="H3-OPTION-080",
                )
        waiting: list[RenderedVideo] = []
        uncommitted, failures = 0, 0
        bar = progress(total=len(writer) + len(jobs), initial=len(writer), desc="simulate", unit="episode")
        filming = VideoJob(
            self.cameras, threads=executor.threads, people=self.people, light=self.light, backend=backend
        )
        done, stopped = len(writer), None
        with bar, closing(film_jobs(jobs, filming=filming, executor=executor)) as results:
            while True:
                try:
                    filmed = next(results, None)
                except JobStopError as stop:
                    filmed, stopped = None, stop
                if filmed is None:
                    break
                waiting.append(filmed)
                if is_failed(filmed.recording):
                    bar.set_postfix(failed=(failures := failures + 1), refresh=False)
                else:
                    played = played or filmed.recording
                if played is not None:
                    with uninterrupted():
                        for each in waiting:
                            with each.video_files() as videos:
                                it = each.recording
                                writer.add(beside(it, played) if is_failed(it) else it, videos=videos)
                            uncommitted += len(it) * (1 + FRAME_STEPS * len(self.cameras))
                        waiting.clear()
                        if uncommitted >= COMMIT_STEPS:
                            writer.commit()
                            uncommitted = 0
                bar.update()
        with uninterrupted():
            writer.commit()
        if stopped is not None:
            raise stopped_job(stopped, [job.index for job in jobs[len(writer) - done :]])
        if waiting:
            first = waiting[0].recording.episode
            raise H3DataError(
                f"No episode could be played, {counted(len(waiting), 'episode')} failed. The first, {first.episode_id} in "
                f"{first.scene} (seed {first.seed}): {first.info['failed']}",
                code="H3-OPTION-041",
            )

    def jobs(self) -> Sequence[Job]:
        """Return the jobs of all episodes, or raise an `InputError` that names the invalid option."""
        return self._jobs().jobs

    def _jobs(self) -> FileJobs:
        """Return all episodes, and why others of a file are left out."""
        check_numbers(
            episodes=self.episodes,
            homes=self.homes,
            max_steps=self.max_steps,
            seed=self.seed,
            human_speed=self.human_speed,
        )
        if self.spawn_distance is not None and not 0 <= self.spawn_distance < math.inf:
            raise InputError(f"--spawn-distance must not be negative, got {self.spawn_distance}.", code="H3-OPTION-042")
        check_workers(self.executor, self.workers)
        choices = Choices(
            task=self.task,
            policy=",".join(self.policies) or None,
            partner=",".join(self.partners) or None,
            agents=self.agents or None,
            human=self.human,
            robot=self.robot,
            motion=None if self.motion is None else str(self.motion),
            rules=self.rules,
            human_speed=self.human_speed,
            max_steps=self.max_steps,
            spawn_distance=self.spawn_distance,
            overrides=read_overrides(self.overrides, card=self.card, observe=self.observe),
            sensors=self.sensors or None,
        )
        choices = with_skills(choices, ",".join(self.skills))
        in_set = self.episodes_file is None and len(self.scenes) == 1
        in_set = in_set and find_scene_set(self.scenes[0].partition("#")[0]) is not None
        if in_set and choices.found_task.usage.set_rules:
            refuse_beside(f"--scenes {self.scenes[0]}", spawn_distance=self.spawn_distance is not None)
        return requested_jobs(self, choices, default_scenes=("small",))


def _kept(out: AnyPath) -> str:
    """Say what an interrupted run leaves behind."""
    held = unfinished_dataset(out)
    return f"{out} holds {held}: the same command with --resume goes on" if held else ""
