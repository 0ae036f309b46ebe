"""Conversion of rearrangement episodes to and from JSON, in recordings, in h3data's files and in Habitat's files.

Starts that are missing in Habitat's files are sampled.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from typing import Any, ClassVar

import msgspec
import numpy as np

from h3data.bodies import load_humanoid, load_robot
from h3data.bodies.names import split_walk
from h3data.errors import InputError, SceneError
from h3data.geometry import Array, quat_rotate
from h3data.plugins import names_from_data
from h3data.recording import Recording
from h3data.recording.assets.scenes import scene_attachment
from h3data.recording.task_episodes.episode_files import episode_files
from h3data.recording.task_episodes.partnr_goals import Placement
from h3data.recording.task_episodes.rearrange_episode import RearrangeEpisode as FileEntry
from h3data.recording.task_episodes.stored_episodes import plain
from h3data.recording.task_episodes.stored_rearrangements import (
    StoredGoal,
    StoredRearrangement,
    content_digest,
    read_rearrangement,
    rearrangement_entry,
)
from h3data.scene import FreeSpace, Scene, scene_digest
from h3data.scene.sources import SceneFile, SceneSource
from sim_kinematic.agents.driven.object_room import object_extent
from sim_kinematic.agents.roster import ROBOT_BODY, kinds_of, make_roster, with_body
from sim_kinematic.agents.stands import robot_fits
from sim_kinematic.motion.randomness import generator
from sim_kinematic.motion.spec import STEP_S, SocialNavSpec
from sim_kinematic.policies.assignment import SOLO, AssignedPolicy
from sim_kinematic.policies.rearrange import planner, population_of
from sim_kinematic.policies.searching import Seeking
from sim_kinematic.tasks.codec import (
    EpisodeCodec,
    EpisodePlace,
    SceneAndMap,
    malformed_info,
    policy_entries,
    read_rules,
    recorded_roster,
    require_info,
    require_on_floor,
    starts_on_floor,
    uid_of,
)
from sim_kinematic.tasks.episode import MAX_STEPS, Episode, Starts, rules_dict, sample_pair_starts
from sim_kinematic.tasks.play import WorldRollout
from sim_kinematic.tasks.rearrange.episode import (
    PAIR,
    SPARE,
    RearrangeEpisode,
    RearrangeSpec,
    Target,
    body_indices,
    free_spot,
    pair_of,
    rules_in,
    seconds_alone,
    starts_of,
)
from sim_kinematic.tasks.recorder import run


class RearrangeCodec(EpisodeCodec[StoredRearrangement]):
    """Codec of episodes with starts, objects and goals; the starts of further agents follow from the seed."""

    records_judgement: ClassVar[bool] = False
    samples_starts: ClassVar[bool] = True

    def record(self, episode: Episode) -> StoredRearrangement:
        """Return the record of an episode: goals, starts of the first robot and person, objects, rules, and scene."""
        assert isinstance(episode, RearrangeEpisode)
        robot, human = episode.pair_starts.places.tolist()
        record = StoredRearrangement(
            goals=tuple(goal_record(target) for target in episode.targets),
            robot_start=tuple(robot),
            human_start=tuple(human),
            objects=episode.added,
            object_paths=episode.object_paths,
            floor_y=float(episode.free.height_at(episode.starts[0, :2])),
            seed=episode.seed,
            robot=f"robot/{episode.pair[0]}",
            human=f"humanoid/{split_walk(episode.pair[1])[0]}",
            scene_sha256=scene_digest(episode.scene),
            scene_source=plain(dict(episode.scene.source)),
            rules=rules_to_json(episode.spec),
            instruction=episode.wording,
        )
        # where somebody edits the entry, the digest differs, and the identity names its places too
        if episode.is_sampled:
            record = msgspec.structs.replace(record, sampled_sha256=content_digest(record))
        return record

    def entry(
        self, record: StoredRearrangement, *, episode_id: str, scene_id: str, scene_dataset_config: str = "default"
    ) -> FileEntry:
        """Return the entry of an episode file: Habitat's rearrangement episode, with the record in its info."""
        return rearrangement_entry(
            record, episode_id=episode_id, scene_id=scene_id, scene_dataset_config=scene_dataset_config
        )

    def read(self, entry: FileEntry, *, seed: int) -> StoredRearrangement | None:
        """Return the record in an entry of a file, or None if the entry belongs to another task.

        An incomplete record gets the seed, from which the rest is sampled.
        """
        record = read_rearrangement(entry)
        return record if record is None or self.is_complete(record) else msgspec.structs.replace(record, seed=seed)

    def is_complete(self, record: StoredRearrangement) -> bool:
        """Return whether both starts and all places of objects are in the record, so that nothing needs sampling."""
        return record.robot_start is not None and record.human_start is not None and not record.placements

    def rules(self, record: StoredRearrangement) -> RearrangeSpec:
        """Return the rules in a record, or the default rules for its number of objects if it has none.

        Raises:
            InputError: the rules and the goals disagree about the number of objects.
        """
        count = len(record.goals) + len(record.placements)
        if not record.rules:
            return self.task.Spec(objects=count)
        spec = rules_from_json(record.rules, self.task.Spec)
        if spec.objects != count:
            raise InputError(
                f"The episode has {count} goals, its rules say {spec.objects} objects.", code="H3-TASK-017"
            )
        return spec

    def stand_ins(self, record: StoredRearrangement, source: SceneSource) -> tuple[str, ...]:
        """Return a sentence for each object asset that is not installed and is replaced by a box."""
        if not record.objects or not (record.com_frames or isinstance(source, SceneFile)):
            return ()  # a home that is built again has its things
        return tuple(episode_files().stand_ins(source, record.objects, record.object_paths))

    def episode(self, record: StoredRearrangement, place: EpisodePlace) -> RearrangeEpisode:
        """Return the episode of a record in an opened scene; parts that the record lacks are sampled with its seed."""
        spec: RearrangeSpec = place.spec
        count = len(record.goals) + len(record.placements)
        if spec.objects != count:
            raise InputError(
                f"The episode has {count} objects: leave out the rule objects={spec.objects}.", code="H3-TASK-018"
            )
        pair = (
            place.robot or record.robot.removeprefix("robot/") or ROBOT_BODY,
            with_body(place.human, record.human.removeprefix("humanoid/")),
        )
        # the user may name any robot, a file only those that are built in, installed or trusted
        with nullcontext() if place.robot else names_from_data():
            robot = load_robot(pair[0])
        roster = make_roster(place.agents or PAIR, robot=pair[0], human=pair[1])
        # the pair's robot too, even if it does not play: places and starts are sampled by its reach
        for body in (robot, *(member.body for member in roster)):
            body.require_arm()
        scene, targets = self._furnished(record, place)
        if not record.rules:
            spec = rules_in(scene, spec)
        if record.placements:
            targets += placed(scene, place.free, record.seed, spec, record.placements, pair)
        starts, complete = self._starts(record, place, scene, targets, pair)
        # the identity follows from the seed only if neither file nor user has changed rules or bodies
        unchanged = (
            complete
            and record.sampled_sha256 == content_digest(record)
            and place.spec == self.rules(record)
            and (pair[0], split_walk(pair[1])[0])
            == (record.robot.removeprefix("robot/"), record.human.removeprefix("humanoid/"))
        )
        return RearrangeEpisode(
            scene=scene,
            free=place.free,
            seed=record.seed,
            spec=spec,
            roster=roster,
            starts=starts_of(scene, place.free, record.seed, spec, starts, roster),
            targets=targets,
            pair=pair,
            pair_starts=starts,
            added=record.objects,
            object_paths=record.object_paths,
            wording=record.instruction,
            is_sampled=unchanged,
        )

    def _furnished(self, record: StoredRearrangement, place: EpisodePlace) -> tuple[Scene, tuple[Target, ...]]:
        """Return the scene with the episode's own objects, and what has to go where in it."""
        scene = place.scene
        origins: Mapping[str, Array] = {}
        # an exported home lacks what moves; the home itself, built again, has it
        built = {i.name for i in scene.instances} if scene.source.get("kind") == "home" else set()
        objects = [thing for thing in record.objects if thing.name not in built]
        if objects:
            scene, origins = episode_files().add_objects(scene, objects, record.object_paths, place.assets)
        movable = {i.name for i in scene.instances if i.motion == "kinematic"}
        lost = [goal.object for goal in (*record.goals, *record.placements) if goal.object not in movable]
        if lost:
            raise SceneError(
                f"The scene {scene.name!r} has no movable thing {', '.join(map(repr, lost[:4]))}. Expected the scene for "
                "which the episode was made.",
                code="H3-TASK-019",
            )
        known = {f"{i.name}|{r.name}" for i, r in scene.receptacles()}
        strange = [
            name for goal in record.goals for name in (goal.source, goal.destination) if name and name not in known
        ]
        if strange and not record.objects:
            raise SceneError(
                f"The scene {scene.name!r} has no receptacle {strange[0]!r}. Expected the scene for which the episode was "
                "made.",
                code="H3-TASK-020",
            )
        return scene, tuple(
            target_of(goal, origins.get(goal.object) if record.com_frames else None) for goal in record.goals
        )

    def _starts(
        self,
        record: StoredRearrangement,
        place: EpisodePlace,
        scene: Scene,
        targets: tuple[Target, ...],
        pair: tuple[str, str],
    ) -> tuple[Starts, bool]:
        """Return the starts of the pair, and whether the file has them."""
        known = [start for start in (record.robot_start, record.human_start) if start is not None]
        on_floor = starts_on_floor(place.free, known)
        if len(known) == 2:
            return Starts.of(on_floor), True
        places = sampled_starts(scene, place.free, record.seed, place.spec, targets, pair).places
        if len(known) == 1:
            # one start is the file's: the distance of the rules was tested against the drawn one
            places[0 if record.robot_start is not None else 1] = on_floor[0]
        return Starts.of(places), False

    # --- recordings ---------------------------------------------------------------------------------------------------
    def restore(self, recording: Recording, scene: SceneAndMap) -> RearrangeEpisode:
        """Return the episode of a recording, from the rules, starts and goals in its info.

        Raises:
            InputError: the recording lacks rules, starts or goals.
        """
        info, agents = recording.episode.info, recording.agents
        require_info(recording, "spec", "goals")
        kinds = tuple(agent.kind for agent in agents)
        own = {"robot": "robot_start", "human": "human_start"}
        try:
            rules = dict(msgspec.convert(info["spec"], dict[str, Any]))
            rules["arm_rad_s"] = np.inf if rules.get("arm_rad_s", 0.0) is None else rules.get("arm_rad_s", 8.0)
            # as in versions that had no such rules
            rules = {"robot": {}, "human": {}, "people_give_way": False, **rules}
            spec = msgspec.convert(rules, self.task.Spec)
            goals = msgspec.convert(info["goals"], list[StoredGoal])
            listed = info["starts"] if "starts" in info else [info[own[kind]] for kind in kinds]
            starts = np.array(msgspec.convert(listed, list[tuple[float, float, float]]), np.float64)
        except (msgspec.ValidationError, KeyError) as fault:
            raise malformed_info(fault) from None
        roster = recorded_roster(agents)
        if spec.max_steps > MAX_STEPS or len(goals) != spec.objects:
            raise InputError(
                f"Expected at most {MAX_STEPS} steps and a goal for each of {spec.objects} objects, got "
                f"{spec.max_steps} steps and {len(goals)} goals.",
                code="H3-TASK-025",
            )
        home, free = scene(spec.agent_radius_m, spec.agent_height_m)
        things = {instance.name for instance in home.instances}
        numbers = [[*goal.start, *goal.position] for goal in goals]
        if not all(len(n) == 10 and np.isfinite(n).all() for n in numbers) or not {g.object for g in goals} <= things:
            raise InputError(
                "Expected goals of things in the scene, with a pose7 start and a position [3] of finite numbers.",
                code="H3-TASK-026",
            )
        require_on_floor(starts, free, len(roster))
        first = [starts[kinds.index(kind)] if kind in kinds else np.full(3, np.nan) for kind in PAIR]
        return RearrangeEpisode(
            scene=home,
            free=free,
            seed=recording.episode.seed,
            spec=spec,
            roster=roster,
            starts=starts,
            targets=tuple(map(target_of, goals)),
            pair=pair_of(roster),
            pair_starts=Starts.of(np.array(first)),
            wording=str(info.get("instruction") or ""),
        )

    def instruction(self, episode: Episode) -> str:
        """Return the instruction of the episode file, or else a sentence that names each object and its goal."""
        assert isinstance(episode, RearrangeEpisode)
        if episode.wording:
            return episode.wording
        places = [f"the {words}" if (words := spoken(t.destination)) else "its goal" for t in episode.targets]
        things = [spoken(t.name) or "object" for t in episode.targets]
        return " and ".join(f"bring the {thing} to {place}" for thing, place in zip(things, places, strict=True))

    def info(self, episode: Episode, policies: Sequence[AssignedPolicy]) -> dict[str, Any]:
        """Return policies, rules, starts, objects and goals for the recording's info."""
        assert isinstance(episode, RearrangeEpisode)
        return {
            **(names := _policy_entries(policies)),
            "partner_plan": ",".join(p.plan for p in policies if p.plan),
            "population": population_of(names["partner"]),
            "max_steps": episode.spec.max_steps,
            "spec": rules_to_json(episode.spec),
            **({"skills": episode.spec.skills} if episode.spec.skills else {}),
            **_starts(episode),
            "goal_objects": body_indices(episode),
            "goals": [msgspec.to_builtins(goal_record(target)) for target in episode.targets],
        }

    def uid(self, episode: Episode, policies: Sequence[AssignedPolicy]) -> str:
        """Return an identifier of the episode, derived from scene, agents, seed, policies and rules.

        For episodes from files it depends on their places too.
        """
        assert isinstance(episode, RearrangeEpisode)
        digest, kinds = scene_attachment(episode.scene)[1], kinds_of(episode.roster)
        (policy, partner), (robot, human) = _policy_entries(policies).values(), episode.pair
        what = f"{self.task.name}:{digest}:{robot}:{human}:{episode.seed}:{policy}:{partner}:{episode.spec}"
        # the bodies of a pair are named already, and the policy solo marks a person alone
        if kinds not in (PAIR, ("human",)):
            what += ":" + ",".join(member.model for member in episode.roster)
        if not episode.is_sampled:
            what += f":{episode.pair_starts.places.tolist()}:{[goal_record(target) for target in episode.targets]}"
        return uid_of(what)

    def final_info(self, episode: Episode, play: WorldRollout, policies: Sequence[AssignedPolicy]) -> dict[str, Any]:
        """Return the reason for the episode's end, and ``solo_steps``, which is ``L_human`` in the paper."""
        assert isinstance(episode, RearrangeEpisode)
        # one agent with this plan has just played the reference itself
        alone = [policy.plan for policy in policies] == ["both"]
        return {"ended": play.ended, "solo_steps": play.step if alone else solo_steps_of(self.task, episode)}

    def precompute(self, episode: Episode) -> dict[str, Any]:
        """Return the number of steps in which the first person alone would finish, which relative metrics need."""
        assert isinstance(episode, RearrangeEpisode)
        return {"solo_steps": solo_steps_of(self.task, episode)}

    def load_precomputed(self, episode: Episode, facts: Mapping[str, Any]) -> None:
        """Take over the solo steps that were recorded or that another process has computed."""
        assert isinstance(episode, RearrangeEpisode)
        if facts.get("solo_steps") is not None:
            keep_solo_steps(episode, int(facts["solo_steps"]))


def sampled_starts(
    scene: Scene,
    free: FreeSpace,
    seed: int,
    spec: RearrangeSpec,
    targets: tuple[Target, ...],
    pair: tuple[str, str],
) -> Starts:
    """Sample starts for goals that a file gives.

    From these starts a person alone can finish in time; if no such starts are found, the best ones tried are returned.

    Raises:
        SceneError: the scene has no two starts that are far enough apart.
    """
    rules = SocialNavSpec(spawn_distance_m=spec.spawn_distance_m, robot=spec.robot)
    robot, human = load_robot(pair[0]), load_humanoid(pair[1])
    fits = robot_fits(robot, spec.robot, scene, free)
    best: tuple[float, Starts] | None = None
    # 20: number of pairs of starts that are tried for a file without starts; beyond it, a person need not be able
    # to do the work in time
    for attempt in range(20):
        rng = generator(seed, "rearrange_starts", step=attempt)
        starts = sample_pair_starts(free, int(rng.integers(2**63)), rules, fits=fits)
        # the slower order counts, as for episodes that are sampled whole
        orders = (targets, targets[::-1])
        seconds = max(seconds_alone(scene, free, spec, robot, human, starts, order) for order in orders)
        if best is None or seconds < best[0]:
            best = seconds, starts
        if seconds <= SPARE * spec.max_steps * STEP_S:
            return starts
    assert best is not None
    if not np.isfinite(best[0]):
        logging.getLogger(__name__).warning(
            "%s: a person cannot reach all objects and goals of an episode from any start tried", scene.name
        )
    return best[1]


def placed(
    scene: Scene,
    free: FreeSpace,
    seed: int,
    spec: RearrangeSpec,
    placements: Sequence[Placement],
    pair: tuple[str, str],
) -> tuple[Target, ...]:
    """Return goals for objects that may be put anywhere on some furniture: free spots that both agents reach.

    Raises:
        SceneError: the furniture has no such spot.
    """
    things = {i.name: i for i in scene.instances}
    named = {p.object for p in placements}
    taken: list[tuple[Array, float]] = [
        (i.pose[:3], object_extent(scene, i)[0])
        for i in scene.instances
        if i.motion == "kinematic" and i.name not in named
    ]
    targets = []
    for number, placement in enumerate(placements):
        surfaces = [(i, r) for i, r in scene.receptacles() if i.name.partition("/")[0] in placement.receptacles]
        # a stream for each object: attempts for one do not shift the draws for the next
        rng = generator(seed, "rearrange_places", step=number)
        spot = free_spot(
            scene,
            free,
            spec,
            load_robot(pair[0]),
            load_humanoid(pair[1]),
            surfaces,
            rng,
            things[placement.object],
            taken,
        )
        if spot is None:
            raise SceneError(
                f"Found no place for {placement.object!r} within reach of both agents on {' or '.join(placement.receptacles)}: "
                + (
                    f"{len(surfaces)} surfaces were tried."
                    if surfaces
                    else "there is no such furniture with a surface."
                ),
                code="H3-TASK-021",
            )
        targets.append(Target(placement.object, things[placement.object].pose, spot[0], placement.source, spot[1]))
    return tuple(targets)


def goal_record(target: Target) -> StoredGoal:
    """Return a target in the form of files and recordings."""
    return StoredGoal(
        object=target.name,
        start=target.start.tolist(),
        position=target.goal.tolist(),
        source=target.source,
        destination=target.destination,
    )


def target_of(goal: StoredGoal, origin: Array | None = None) -> Target:
    """Return the target of a record.

    ``origin`` [3] [m] is the object's center of mass in the asset's axes, to which the poses in the record refer.
    """
    start, position = np.array(goal.start, np.float64), np.array(goal.position, np.float64)
    # Habitat's poses are those of the center of mass, ours those of the asset's origin
    if origin is not None:
        start[:3] -= quat_rotate(start[3:], origin)
        position -= quat_rotate(np.array(goal.rotation or start[3:], np.float64), origin)
    return Target(goal.object, start, position, goal.source, goal.destination)


def rules_to_json(spec: RearrangeSpec) -> dict[str, Any]:
    """Return the rules as JSON types, with null for the speed of an infinitely fast arm."""
    # as in recordings from before there was a choice
    since = {"observe": "full", "chores": False}
    rules = {name: value for name, value in rules_dict(spec).items() if name not in since or value != since[name]}
    # JSON has no infinity
    if not np.isfinite(spec.arm_rad_s):
        rules["arm_rad_s"] = None
    return rules


def rules_from_json(rules: Mapping[str, Any], kind: type[RearrangeSpec] = RearrangeSpec) -> RearrangeSpec:
    """Return the rules from the JSON types of `rules_to_json`; rules that are not named are those of the paper.

    Raises:
        InputError: the rules are not rules of rearrangement.
    """
    known = dict(rules)
    if "arm_rad_s" in known and known["arm_rad_s"] is None:
        known["arm_rad_s"] = np.inf
    # left open, it would be True with every base but Habitat's, where the paper's rules have False
    return read_rules(known, kind, people_give_way=False)


# --- in words -----------------------------------------------------------------------------------------------------------
def spoken(name: str) -> str:
    """Return the kind of thing that a name refers to: ``tv_stand_0|top_left`` is a "tv stand".

    ``name`` is that of an instance or receptacle. Habitat's names have numbers at both ends and colons
    (``003_cracker_box_:0000``), or are hashes, which contain no words.
    """
    instance = name.partition("|")[0].partition(":")[0].rpartition("/")[2]
    # with at least one digit: a long word may consist of the letters a to f
    digest = re.compile(r"(?=[0-9a-f]*\d)[0-9a-f]{12,}")
    words = [word for word in re.split(r"[_\W]+", instance) if word and not digest.fullmatch(word)]
    return re.sub(r"^(\d+ )+|( \d+)+$", "", " ".join(words)) or ("" if digest.search(instance) else instance)


def _policy_entries(policies: Sequence[AssignedPolicy]) -> dict[str, str]:
    """Return `policy_entries`; the policy is `SOLO` for a person alone."""
    alone = [policy.kind for policy in policies] == ["human"]
    return policy_entries(policies) | ({"policy": SOLO} if alone else {})


def _starts(episode: RearrangeEpisode) -> dict[str, list[Any]]:
    """Return the starts ``(x, z, heading)``: of robot and person as sampled, else of each agent."""
    if kinds_of(episode.roster) in (PAIR, ("human",)):
        robot, human = episode.pair_starts.places.tolist()
        return {"robot_start": robot, "human_start": human}
    return {"starts": episode.starts.tolist()}


_SOLO_STEPS = "_solo_steps"


def solo_steps_of(task: Any, episode: RearrangeEpisode) -> int:
    """Return the number of steps in which one person alone brings all objects to their goals (paper: ``L_human``).

    The number is at most ``max_steps``. It is computed by simulating the first person, or the first robot if there are
    no people. ``task`` is the `sim_kinematic.tasks.task.Task` of the episode, which caches the number.
    """
    # beside the fields of the frozen episode: replace() leaves it out, so other agents count anew
    if _SOLO_STEPS not in vars(episode):
        vars(episode)[_SOLO_STEPS] = _simulated_solo_steps(task, episode)
    return vars(episode)[_SOLO_STEPS]


def _simulated_solo_steps(task: Any, episode: RearrangeEpisode) -> int:
    kinds = kinds_of(episode.roster)
    first = kinds.index("human") if "human" in kinds else 0
    alone = episode.only(first)
    policy: Any = planner("both", episode.seed, len(episode.targets))
    # the reference has to search as well, or it would know more than those compared with it
    policy = Seeking(policy) if episode.spec.observe == "seen" else policy
    play = WorldRollout.of(task, alone, [AssignedPolicy(policy, "both", kinds[first], "both")])
    run(play)
    return play.step


def keep_solo_steps(episode: RearrangeEpisode, steps: int) -> None:
    """Store a known number of steps for `solo_steps_of` to return."""
    vars(episode)[_SOLO_STEPS] = steps
