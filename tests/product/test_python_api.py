"""What `import h3data` offers: jobs with the options of the commands, everything opened by the names commands take."""

from __future__ import annotations

import copy
import inspect
import json
import pickle
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import h3data
import h3data_viewers.api
from h3data.bodies import load_robot
from h3data.commands.command import Command
from h3data.commands.options import command_of, options_of, python_value
from h3data.errors import InputError
from h3data.recording import write_mcap
from h3data_pipelines import api
from h3data_pipelines.commands.evaluating import Evaluate
from h3data_pipelines.commands.exporting import Export
from h3data_pipelines.commands.generate import Generate
from h3data_pipelines.commands.importing import Import
from h3data_pipelines.hub.card import Card
from h3data_pipelines.hub.pulling import Pull
from h3data_pipelines.hub.pushing import Push
from h3data_pipelines.hub.syncing import Sync
from h3data_pipelines.pictures.rerender import Rerender
from h3data_viewers.commands.reporting import ReportCommand
from h3data_viewers.commands.viewing import View
from sim_kinematic.policies.policy import Still
from tests.paths import DATA, ROOT

COMMANDS: list[tuple[Callable[..., Any], type[Command]]] = [
    (api.generate, Generate),
    (api.evaluate, Evaluate),
    (h3data_viewers.api.report, ReportCommand),
    (api.import_, Import),
    (api.export, Export),
    (api.rerender, Rerender),
    (h3data_viewers.api.view, View),
    (api.card, Card),
    (api.push, Push),
    (api.pull, Pull),
    (api.sync, Sync),
]


@pytest.fixture(scope="module")
def generated(tmp_path_factory: pytest.TempPathFactory) -> Any:
    out = tmp_path_factory.mktemp("api") / "ds"
    return h3data.generate("wander", out, episodes=4, homes=2, max_steps=20)


@pytest.mark.parametrize(("function", "command"), COMMANDS, ids=lambda x: getattr(x, "__name__", ""))
def test_functions_have_the_options_of_their_commands(function: Callable[..., Any], command: type[Command]) -> None:
    parameters = inspect.signature(function).parameters
    options = {o.field: o for o in options_of(command)}
    missing = set(options) - set(parameters) - {"json", "dry_run"}
    assert not missing, f"{function.__name__} lacks options of the command: {missing}"
    assert set(parameters) <= set(options)
    for name, parameter in parameters.items():
        assert options[name].required == (parameter.default is inspect.Parameter.empty), name
        assert "Any" not in parameter.annotation, name


def test_names_and_defaults_of_a_command_are_those_of_its_function() -> None:
    def play(
        task: str, *, scenes: str = "small", speed: float | None = None, cameras: Sequence[str] = ("a", "b")
    ) -> None:
        """What `h3data` would offer."""

    class Complete:
        task: str
        scenes: tuple[str, ...]
        speed: float | None
        cameras: tuple[str, ...]
        json: bool = False

    made: Any = command_of(play)(Complete)(task="x")
    assert (made.task, made.scenes, made.speed, made.cameras, made.json) == ("x", ("small",), None, ("a", "b"), False)

    class Lacking:
        task: str
        scenes: tuple[str, ...]
        speed: float | None

    with pytest.raises(TypeError, match="a field cameras without a default in Lacking"):
        command_of(play)(Lacking)

    class Twice:
        task: str
        scenes: tuple[str, ...]
        speed: float | None = 3.0
        cameras: tuple[str, ...]

    with pytest.raises(TypeError, match="a field speed without a default in Twice"):
        command_of(play)(Twice)


@pytest.mark.parametrize(
    ("given", "value"),
    [
        ({"cameras": "top_down"}, ("top_down",)),
        ({"cameras": [Path("my.toml"), "top_down"]}, ("my.toml", "top_down")),
        ({"agents": ["human", load_robot("lift_arm")]}, ("human", "lift_arm")),
        ({"robot": load_robot("quad_arm")}, "quad_arm"),
        ({"policies": Still}, ("sim_kinematic.policies.policy:Still",)),
        ({"overrides": {"objects": 3, "near_m": [2.0, 1.5]}}, ("objects=3", "near_m=[2.0, 1.5]")),
    ],
    ids=lambda x: str(x)[:20],
)
def test_python_gives_one_thing_or_several_by_name_or_itself(given: dict[str, Any], value: Any) -> None:
    ((name, thing),) = given.items()
    (option,) = (option for option in options_of(Generate) if option.field == name)
    assert python_value(option, thing) == value


def test_a_policy_by_its_class_and_rules_by_name(tmp_path: Path) -> None:
    done = h3data.generate(
        "wander", tmp_path, policies=Still, overrides={"max_steps": 12}, scenes=["small:1", "small:2"], episodes=2
    )
    assert [len(recording) for recording in done.dataset] == [12, 12]
    first = done.dataset[0]
    assert first.episode.info["job"]["policy"] == "sim_kinematic.policies.policy:Still"
    assert np.ptp(first.columns["agent_0.base_pose"][:, :3], axis=0).max() == 0


def test_generate_returns_the_dataset(generated: Any) -> None:
    assert (len(generated.dataset), generated.new, generated.failed) == (4, 4, ())
    assert generated.metrics.to_dict()["episodes"]
    with pytest.raises(InputError, match=r"(?s)finished episodes.*H3-OPTION-009"):
        h3data.generate("wander", generated.dataset.root, episodes=1)


def test_refusals_name_parameters(generated: Any) -> None:
    out = generated.dataset.root
    with pytest.raises(
        InputError, match=r"(?s)a dataset of 4 finished episodes\. resume=True.*force=True.*H3-OPTION-009"
    ):
        h3data.generate("wander", out, episodes=4, homes=2, max_steps=20)
    with pytest.raises(InputError, match=r"(?s)^episodes .* 1, .*-1.*H3-JOB-025"):
        h3data.generate("wander", out, episodes=-1, resume=True)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"episodes": "four"}, "episodes: expected a whole number, got 'four'."),
        ({"episodes": 4.0}, "episodes: expected a whole number, got 4.0."),
        ({"human_speed": "fast"}, "human_speed: expected a number, got 'fast'."),
        ({"cameras": ["top_down", 3]}, "cameras: expected a name or path, got 3."),
        ({"light": "bakd"}, "light: unknown 'bakd'. Did you mean 'baked'?"),
        ({"resume": "yes"}, "resume: expected True or False, got 'yes'."),
        ({"scenes": 3}, "scenes: expected a name or path, got 3."),
    ],
)
def test_values_of_other_types_are_refused(options: dict[str, Any], said: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=rf"(?ms)^{re.escape(said)}$.*H3-OPTION-01[34]"):
        h3data.generate("wander", tmp_path, **options)


def test_things_of_other_types_are_refused_in_one_line(generated: Any) -> None:
    dataset: Any = generated.dataset
    replay: Any = h3data.Replay(dataset[0])
    wrong: Any = 3
    for call, said in (
        (lambda: h3data.open(wrong), r"(?s)Expected\ a\ path,\ URI\ or\ name,\ got\ 3.*H3-FILE-001"),
        (lambda: h3data.measure(wrong), r"(?s)Expected\ recordings,\ a\ dataset\ or\ a\ path,\ got\ 3.*H3-FILE-004"),
        (
            lambda: dataset["first"],
            r"(?s)Expected\ the\ number\ of\ an\ episode\ or\ a\ slice,\ got\ 'first'.*H3-RECORDING-057",
        ),
        (lambda: replay.at("a"), r"(?s)Expected\ a\ step\ as\ a\ whole\ number,\ got\ 'a'.*H3-REPLAY-027"),
        (
            lambda: h3data.render_frame(replay, step=wrong / 2),
            r"(?s)Expected\ a\ step\ as\ a\ whole\ number,\ got\ 1\.5.*H3-REPLAY-027",
        ),
        (lambda: h3data.render_frame("ds#0"), r"(?s)Expected\ a\ Recording,\ got\ 'ds\#0'.*H3-REPLAY-021"),  # type: ignore[arg-type]
        (
            lambda: h3data.session("wander", max_step=3),
            r"(?s)Unknown\ rule\ 'max_step'\.\ Did\ you\ mean\ 'max_steps'\?.*H3-JOB-020",
        ),
    ):
        with pytest.raises(InputError, match=said):
            call()


def test_an_unknown_column_says_what_was_meant(generated: Any) -> None:
    recording = generated.dataset[0]
    for look_up in (lambda: recording.columns["agent_0.pose"], lambda: recording.agent_column(0, "pose")):
        with pytest.raises(KeyError) as caught:
            look_up()
        assert str(caught.value) == "No column 'agent_0.pose' in this recording. Did you mean 'agent_0.base_pose'?"
        assert isinstance(caught.value, InputError)
    assert "agent_0.pose" not in recording.columns
    assert pickle.loads(pickle.dumps(recording.columns)).keys() == recording.columns.keys()


def test_view_rerender_and_export_return_files(generated: Any, tmp_path: Path) -> None:
    episode = f"{generated.dataset.root}#1"
    assert h3data.view(episode, out=tmp_path / "a.rrd").stat().st_size > 1000
    rendered = h3data.rerender(episode, tmp_path / "pictures", steps="0:2", format="png", cameras="top_down")
    assert rendered.failed == {}
    assert [path.name for path in rendered.files] == ["ds#1.top_down.rgb"]
    report = h3data.report(generated.dataset.root, tmp_path / "report.html", pictures=0)
    assert [len(run.episodes) for run in report.data.runs] == [4]
    assert h3data.export(episode, tmp_path / "tables", to="csv").is_dir()


# --- open --------------------------------------------------------------------------------------------------------------
def test_open_takes_what_commands_take(generated: Any, tmp_path: Path) -> None:
    dataset = h3data.open(generated.dataset.root, h3data.Dataset)
    recording = h3data.open(f"{dataset.root}#2", h3data.Recording)
    for name in ("a", "b"):
        write_mcap(recording, tmp_path / f"{name}.mcap")
    assert len(h3data.open(tmp_path / "*.mcap", h3data.Episodes)) == 2
    assert len(h3data.open(tmp_path)) == 2
    assert h3data.open("small:3", h3data.Scene).name == "home_small_3"
    assert h3data.open("h3-homes/test#0").name == h3data.open("h3-homes/test#test_00").name
    assert len(h3data.load_dataset(dataset.root)) == len(dataset)
    assert h3data.load_recording(f"{dataset.root}#2").episode == recording.episode
    assert h3data.load_scene("small:3").name == "home_small_3"
    for load, other in (
        (h3data.load_scene, dataset.root),
        (h3data.load_recording, "small:3"),
        (h3data.load_dataset, tmp_path / "a.mcap"),
    ):
        with pytest.raises(InputError, match=r"(?s)(Scene|Recording|Dataset).*H3-FILE-002"):
            load(other)
    with pytest.raises(InputError, match="H3-FILE-005"):
        h3data.open("small")
    with pytest.raises(InputError, match=r"(?s)Dataset.*Recording.*H3-FILE-002"):
        h3data.open(tmp_path / "a.mcap", h3data.Dataset)
    with pytest.raises(InputError, match="H3-FILE-003"):
        h3data.open(tmp_path / "*.nothing")


# --- episodes ----------------------------------------------------------------------------------------------------------
def test_slices_filters_and_splits_choose_episodes(generated: Any) -> None:
    dataset = generated.dataset
    uids = [row["uid"] for row in dataset.rows]
    assert [r.episode.uid for r in dataset] == uids
    assert [r.episode.uid for r in dataset[1:3]] == uids[1:3]
    assert [r.episode.uid for r in dataset[::-1]] == uids[::-1]
    scene = dataset.rows[0]["scene"]
    assert len(dataset.filter(scene=scene)) == 2
    assert len(dataset.filter(lambda facts: facts["length"] > 20)) == 0
    with pytest.raises(InputError, match="H3-RECORDING-003"):
        dataset.filter(scen=scene)
    train, test = dataset.split(0.5, by="scene")
    assert {f["scene"] for f in train.facts}.isdisjoint(f["scene"] for f in test.facts)
    assert sorted(f["uid"] for part in (train, test) for f in part.facts) == sorted(uids)
    assert [f["uid"] for f in dataset.split(0.5, by="scene")[0].facts] == [f["uid"] for f in train.facts]
    with pytest.raises(InputError, match="H3-RECORDING-001"):
        dataset.split(0.8, 0.5)


def test_merged_episodes_are_saved_as_a_dataset(generated: Any, tmp_path: Path) -> None:
    dataset = generated.dataset
    write_mcap(dataset[3], tmp_path / "a.mcap")
    both = dataset[:2].merge(h3data.open(tmp_path), dataset[:1])
    assert [f["uid"] for f in both.facts] == [dataset.rows[k]["uid"] for k in (0, 1, 3)]
    both.save(tmp_path / "both")
    saved = h3data.open(tmp_path / "both", h3data.Dataset)
    for index, recording in enumerate(both):
        np.testing.assert_array_equal(saved[index].columns["state_hash"], recording.columns["state_hash"])


def test_measure_takes_recordings_datasets_episodes_and_paths(generated: Any) -> None:
    dataset = generated.dataset
    whole = h3data.measure(dataset).to_dict()
    assert h3data.measure(str(dataset.root)).to_dict() == whole
    assert h3data.measure(dataset[0:4]).to_dict() == whole
    assert h3data.measure(dataset[0]).to_dict()["values"].keys() == set(whole["metrics"])


# --- keyword arguments -------------------------------------------------------------------------------------------------
JOBS = (
    "card",
    "evaluate",
    "export",
    "generate",
    "import_",
    "pull",
    "push",
    "render_frame",
    "report",
    "rerender",
    "run_benchmark",
    "sync",
    "verify_benchmark",
    "view",
)


@pytest.mark.parametrize("name", JOBS)
def test_unknown_keyword_arguments_are_refused_with_the_one_that_was_meant(name: str) -> None:
    job = getattr(h3data, name)
    some = list(inspect.signature(job).parameters)[-1]
    with pytest.raises(TypeError, match=re.escape(f"has no argument '{some}x'. Did you mean '{some}'?")):
        job(**{f"{some}x": 1})
    with pytest.raises(TypeError, match=f"has no argument 'zzzzzzzz'. Expected one of: .*{some}"):
        job(zzzzzzzz=1)
    assert pickle.loads(pickle.dumps(job)) is job


# --- environments ------------------------------------------------------------------------------------------------------
def test_the_version() -> None:
    assert h3data.__version__


@pytest.mark.slow
@pytest.mark.parametrize(
    "script",
    [
        "import gymnasium, h3data; print(gymnasium.make('h3data/SocialNav-v0', scenes='small:1').spec.id)",
        "import gymnasium; print(gymnasium.make('h3data:h3data/SocialNav-v0', scenes='small:1').spec.id)",
        "import h3data, gymnasium; print(gymnasium.make('h3data:h3data/SocialNav-v0', scenes='small:1').spec.id)",
    ],
)
def test_gymnasium_finds_the_environments(script: str) -> None:
    said = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert said.stdout.strip() == "h3data/SocialNav-v0"


@pytest.mark.parametrize(
    "first", ["import h3data, gymnasium", "import h3data.envs, gymnasium", "import gymnasium, h3data"]
)
def test_ids_of_gymnasium_are_known_in_any_order_of_imports(first: str) -> None:
    script = f"{first}; print(gymnasium.spec('h3data/SocialNav-v0').id)"
    said = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert (said.stdout.strip(), said.stderr) == ("h3data/SocialNav-v0", "")


@pytest.mark.parametrize("options", [{}, {"num_envs": 2}, {"agents": ("robot", "human")}], ids=str)
def test_environments_are_pickled_as_their_recipe(options: dict[str, Any]) -> None:
    env = h3data.make("social_nav", "small:1", **options)
    for twin in (pickle.loads(pickle.dumps(env)), copy.deepcopy(env)):
        first, again = env.reset(seed=3)[0], twin.reset(seed=3)[0]
        for left, right in zip(_leaves(first), _leaves(again), strict=True):
            np.testing.assert_array_equal(left, right)


def test_the_specification_makes_the_environment_again() -> None:
    import gymnasium

    env = h3data.make("social_nav", "small:1")
    assert env.spec is not None
    assert env.spec.id == "h3data/SocialNav-v0"
    assert repr(gymnasium.make(env.spec).unwrapped) == repr(env)


def test_wrong_options_of_make_say_what_was_meant() -> None:
    with pytest.raises(InputError, match="H3-ENV-020"):
        h3data.make("social_nav", "small:1", nenvs=3)
    with pytest.raises(InputError, match="H3-ENV-036"):
        h3data.make("wander", "small:1", device="cpu")


def _leaves(value: Any) -> list[Any]:
    return [leaf for each in value.values() for leaf in _leaves(each)] if isinstance(value, dict) else [value]


# --- faces of the simulator -------------------------------------------------------------------------------------------
def test_make_names_every_option_of_every_environment() -> None:
    """`h3data.make` repeats the options of the environments, so that editors, type checkers and the reference know them."""
    from h3data_training.envs.rearrange_torch_env import RearrangeTorchEnv
    from h3data_training.envs.social_nav_torch_env import SocialNavTorchEnv
    from h3data_training.envs.task_torch_env import TaskTorchEnv
    from sim_kinematic.envs import make as maker
    from sim_kinematic.envs.make import MakeOptions
    from sim_kinematic.envs.stepper import Options
    from sim_kinematic.envs.world_stepper import WorldStepper
    from sim_kinematic.tasks.registry import find_task

    def keywords(function: Any) -> set[str]:
        return {p.name for p in inspect.signature(function).parameters.values() if p.kind is p.KEYWORD_ONLY}

    real = keywords(maker.make_env) | {field.name for field in fields(Options)}
    for environment in (WorldStepper, TaskTorchEnv, SocialNavTorchEnv, RearrangeTorchEnv):
        real |= keywords(environment)
    for task in ("social_nav", "rearrange"):
        real |= set(find_task(task).usage.env_options)
    real |= {"rules", "autoreset_mode"}  # which `make` uses itself
    assert keywords(h3data.make) == real - {"worlds", "options", "task"}  # the task is the first parameter of `make`
    assert {*MakeOptions.__annotations__, "num_envs", "device", "agents"} == keywords(h3data.make)
    described = re.findall(r"^ +([a-z_]+): [A-Z`]", (inspect.getdoc(h3data.make) or ""), re.MULTILINE)
    assert set(described) == {"task", "scenes", *keywords(h3data.make)}


def test_environments_and_sessions_take_objects_instead_of_names() -> None:
    from sim_kinematic.tasks.wander import Wander

    home, robot = h3data.load_scene("small:3"), load_robot("lift_arm")
    recording = h3data.simulate(Wander, home, agents={"robot": Still()}, robot=robot, max_steps=3)
    assert (recording.episode.task, recording.episode.scene, recording.agents[0].model) == (
        "wander",
        home.name,
        "robot/lift_arm",
    )
    named = h3data.simulate("wander", [home], roster=[robot, "human"], agents={"robot": Still}, max_steps=3)
    assert [agent.model for agent in named.agents] == ["robot/lift_arm", "humanoid/female_0"]
    env = h3data.make(Wander, [home, "small:1"], robot=robot)
    assert "lift_arm" in repr(env)
    assert "2 scenes of home_small_3, small:1" in repr(env)


def test_sessions_have_the_signature_of_the_simulator() -> None:
    from sim_kinematic.tasks import sessions

    for name in ("session", "simulate"):
        face, real = (inspect.signature(getattr(home, name)).parameters for home in (h3data, sessions))
        assert [(p.name, p.kind, p.default) for p in face.values()] == [
            (p.name, p.kind, p.default) for p in real.values()
        ]


USER_SCRIPT = DATA / "user_script.py"


@pytest.mark.slow
@pytest.mark.parametrize("checker", ["pyright", "mypy"])
def test_a_users_script_passes_a_strict_type_check(checker: str, tmp_path: Path) -> None:
    pytest.importorskip(checker)
    script = Path(shutil.copy(USER_SCRIPT, tmp_path))  # outside the checkout, where our own settings do not apply
    options = ["--strict", f"--cache-dir={tmp_path}/cache"] if checker == "mypy" else ["--pythonpath", sys.executable]
    assert script.read_text().startswith("# pyright: strict\n")
    done = subprocess.run(
        [sys.executable, "-m", checker, *options, str(script)],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        timeout=280,
    )
    assert done.returncode == 0, done.stdout
    wrong = script.read_text().replace("num_envs=4", "num_env=4").replace("episodes=2, agents", 'episodes="2", agents')
    script.write_text(wrong)
    done = subprocess.run(
        [sys.executable, "-m", checker, *options, str(script)],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        timeout=280,
    )
    assert done.returncode == 1, "a misspelt option and a text for a number"
    for said in ("num_env", "int"):
        assert said in done.stdout


@pytest.mark.slow
def test_a_users_script_runs(tmp_path: Path) -> None:
    script = shutil.copy(USER_SCRIPT, tmp_path / "mine.py")
    done = subprocess.run(
        [sys.executable, script], capture_output=True, text=True, cwd=tmp_path, timeout=280, check=True
    )
    assert "mine:TurnAround" in done.stdout
    assert {path.name for path in tmp_path.iterdir()} >= {"out", "table", "videos", "view.html"}


@pytest.mark.slow
def test_type_checkers_refuse_unknown_options(tmp_path: Path) -> None:
    source = tmp_path / "script.py"
    source.write_text(
        "import h3data\n"
        'h3data.make("social_nav", num_env=4)\n'
        'h3data.make("social_nav", num_envs=4, observations=["egomotion"], threads=2)\n'
        'h3data.session("rearrange", scenes="small:3").nothing\n'
    )
    done = subprocess.run(
        [sys.executable, "-m", "pyright", "--outputjson", "--pythonpath", sys.executable, str(source)],
        capture_output=True,
        text=True,
        cwd=ROOT,
        timeout=280,
    )
    found = json.loads(done.stdout)["generalDiagnostics"]
    assert sorted(fault["range"]["start"]["line"] for fault in found if fault["severity"] == "error") == [1, 3]
