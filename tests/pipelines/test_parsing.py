"""What the command line says about words that it cannot use: one line with the word, what was expected, where to look."""

from __future__ import annotations

import ast
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any, get_args

import pytest

import h3data
from h3data.commands.command import Group, RuleSet
from h3data.commands.options import RENAMED, in_python_words, options_of, split_list
from h3data.errors import InputError
from h3data_pipelines.cli import main
from h3data_pipelines.commands import demo
from h3data_pipelines.commands.converting import Convert
from h3data_pipelines.commands.exporting import Export
from h3data_pipelines.commands.generate import Generate
from h3data_pipelines.commands.importing import Import
from h3data_pipelines.commands.table import all_commands
from h3data_pipelines.jobs.episodes import Choices, Job, make_jobs
from h3data_pipelines.jobs.evaluation_runs import EvaluationRequest
from h3data_pipelines.option_words import in_shell_words
from h3data_pipelines.parsing import parse
from h3data_viewers.commands.viewing import View
from sim_kinematic.tasks.registry import find_task

COMMANDS = all_commands()

LEAVES = [
    (words, command)
    for name, top in COMMANDS.items()
    for words, command in (
        [((name, sub), each) for sub, each in top.commands.items()] if isinstance(top, Group) else [((name,), top)]
    )
]
HELP = [*((name,) for name, top in COMMANDS.items() if isinstance(top, Group)), *(words for words, _ in LEAVES)]
REFUSED = {
    "generat": "Unknown command 'generat'. Did you mean 'generate'? See: h3data --help",
    "fly": "Unknown command 'fly'. Expected one of: demo, generate,",
    "scenes lst": "Unknown command 'lst'. Did you mean 'list'? See: h3data scenes --help",
    "--json generate": "Expected a command before --json: h3data COMMAND --json. See: h3data --help",
    "generate": "Missing from h3data generate: TASK and -o/--out. See: h3data generate --help",
    "generate wander": "Missing from h3data generate: -o/--out. See: h3data generate --help",
    "convert a": "Missing from h3data convert: OUT. See: h3data convert --help",
    "generate wander -o x --epsodes 3": "Unknown option '--epsodes'. Did you mean '--episodes'? See: h3data generate --help",
    "metrics a --profil=field": "Unknown option '--profil=field'. Did you mean '--profile'? See: h3data metrics --help",
    "doctor please": "Unknown argument 'please'. See: h3data doctor --help",
    "generate wander -o x --episodes abc": "--episodes: expected a whole number, got 'abc'. See: h3data generate --help",
    "generate wander -o x --episodes None": "--episodes: expected a whole number, got 'None'. See: h3data generate --help",
    "generate wander -o x --seed 1.5": "--seed: expected a whole number, got '1.5'. See: h3data generate --help",
    "generate wander -o x --human-speed nan": "--human-speed: expected a number, got 'nan'. See: h3data generate --help",
    "generate wander -o x --episodes": "Missing value for --episodes. See: h3data generate --help",
    "robots reach quad_arm 1 2": "POINT: expected 3 values, got 2. See: h3data robots reach --help",
    "robots reach quad_arm 1 2 z": "POINT: expected a number, got 'z'. See: h3data robots reach --help",
    "export a --to b -o c": "Cannot export to 'b'. Expected one of: gfx-replay, rosbag2, habitat-episodes,",
    "rerender a --format b -o c": "--format: expected one of mp4, av1, png, data, got 'b'. See: h3data rerender --help",
    "generate --ot x": "Unknown option '--ot'. Did you mean '--out'? See: h3data generate --help",
    "view a -o --json": "Missing value for -o/--out. See: h3data view --help",
    "view a -o": "Missing value for -o/--out. See: h3data view --help",
}


@pytest.mark.parametrize("words", REFUSED)
def test_words_that_cannot_be_used_are_refused_in_one_line(words: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(words.split()) == 2
    out, error = capsys.readouterr()
    assert error.startswith("error: " + REFUSED[words])
    assert error.count("\n") == 1
    if "--json" in words:
        said = json.loads(out)
        assert error == f"error: {said['error']} [{said['code']}]\n"
    else:
        assert not out


def test_refused_words_are_json_too(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor", "--jsn", "--json"]) == 2
    assert json.loads(capsys.readouterr().out)["error"].startswith("Unknown option '--jsn'. Did you mean '--json'?")


@pytest.mark.parametrize("words", HELP, ids=" ".join)
def test_help_tells_defaults_that_say_something(words: tuple[str, ...], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main([*words, "--help"])
    out, error = capsys.readouterr()
    assert (stop.value.code, error) == (0, "")
    told = " ".join(line.strip("│ ") for line in out.splitlines())
    for raw in ("(default: )", "(default: None)", "(default: False)", "(default: '')", "{None}"):
        assert raw not in told
    assert "Examples:" in told
    if words == ("generate",):
        assert "(default: 4)" in told
        assert "--episodes INT" in told


def test_the_first_help_is_one_page(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main([])
    out = capsys.readouterr().out
    assert all(f"\n  {name} " in out for name in COMMANDS)
    assert len(out.splitlines()) <= 66


def test_list_options_take_one_value_each_time() -> None:
    """In every command: several values after one flag would swallow the positional argument behind them."""
    tried = 0
    for words, command in LEAVES:
        for option in options_of(command):
            if not option.flags or option.count is not None:
                continue
            choices = get_args(option.kind)
            value = choices[0] if choices else "1" if option.kind in (int, float) else "a"
            required = [word for o in options_of(command) if o.required and o.flags for word in (o.flags[0], "csv")]
            positional = [o for o in options_of(command) if not o.flags]
            line = [*words, option.flags[-1], value, *required, option.flags[-1], value, *["p"] * len(positional)]
            parsed = parse(line, COMMANDS, about="").command
            assert len(getattr(parsed, option.field)) == 2, line
            for each in positional:
                assert "p" in str(getattr(parsed, each.field)), line
            tried += 1
    assert tried > 8


def test_lists_are_repeated_or_have_commas_alike() -> None:
    """In every command: ``--camera a --camera b``, ``--cameras a,b`` and both at once."""
    tried = 0
    for words, command in LEAVES:
        for option in options_of(command):
            if not option.is_list or option.kind is Path:
                continue
            choices = (
                [*map(str, get_args(option.kind)), "1", "2"][:2]
                if option.kind in (int, float) or get_args(option.kind)
                else ["a", "b"]
            )
            required = [word for o in options_of(command) if o.required and o.flags for word in (o.flags[0], "csv")]
            start = [*words, *("p" for o in options_of(command) if not o.flags), *required]
            first, last = option.flags[0], option.flags[-1]
            for given in ([first, choices[0], last, choices[1]], [last, ",".join(choices)]):
                if option.field == "rules":
                    given = [word.replace("a", "a=1").replace("b", "b=2") for word in given]
                parsed = parse([*start, *given], COMMANDS, about="").command
                assert len(getattr(parsed, option.field)) == 2, (words, given)
            assert len(option.flags) == 2 or not option.flags[0].endswith("s") or option.flags == ("--as",), option
            tried += 1
    assert tried > 15


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("a,b", ["a", "b"]),
        (" a , b,", ["a", "b"]),
        ("objects=3,near_m=[2.0,1.5]", ["objects=3", "near_m=[2.0,1.5]"]),
        ('name="a,b",c=(1,2)', ['name="a,b"', "c=(1,2)"]),
        ("weights:out/s[1,2]/p.npz,still", ["weights:out/s[1,2]/p.npz", "still"]),
    ],
)
def test_commas_within_brackets_and_quotes_divide_nothing(text: str, parts: list[str]) -> None:
    assert split_list(text) == parts


def test_a_path_with_a_comma_is_one_path_if_it_exists(tmp_path: Path) -> None:
    (tmp_path / "a,b").mkdir()
    view: Any = parse(["view", "e", "--assets", f"{tmp_path}/a,b", "--assets", "c,d"], COMMANDS, about="").command
    assert view.assets == (tmp_path / "a,b", Path("c"), Path("d"))


@pytest.mark.parametrize("old", sorted(RENAMED))
def test_old_names_of_options_are_refused_with_the_new_one(old: str, tmp_path: Path) -> None:
    now, tried = RENAMED[old], 0
    for words, command in LEAVES:
        flags = [flag for option in options_of(command) for flag in option.flags]
        if now not in flags or old in flags:
            continue
        with pytest.raises(InputError, match="H3-OPTION-078"):
            parse([*words, old, "x"], COMMANDS, about="")
        job = tmp_path / "job.toml"
        job.write_text(f'{old.lstrip("-")} = "x"')
        with pytest.raises(InputError, match="H3-OPTION-077"):
            parse([*words, "--config", str(job)], COMMANDS, about="")
        tried += 1
    assert tried


def test_help_shows_the_options_of_a_task_with_the_task(capsys: pytest.CaptureFixture[str]) -> None:
    def shown(*words: str) -> str:
        with pytest.raises(SystemExit):
            main([*words, "--help"])
        return " ".join(line.strip("│ ") for line in capsys.readouterr().out.splitlines())

    general, rearrange, social_nav = shown("generate"), shown("generate", "rearrange"), shown("generate", "social_nav")
    assert "--skills" not in general.partition("Examples:")[0]
    assert "rearrange" in general.partition("Each task has more options: ")[2].partition(" See: h3data generate")[0]
    assert "--skills" in rearrange
    assert "plan_pop_1" in rearrange
    assert "end_to_end" not in rearrange
    assert "h3data generate social_nav" not in rearrange
    assert "--skills" not in social_nav
    assert "end_to_end" in social_nav
    assert "--skills" in shown("generate", "my_tasks:Mine")
    assert "--ablate" not in shown("train", "social_nav")
    assert "--ablate" in shown("train", "rearrange")


def test_help_wraps_texts_at_the_terminal_and_not_where_the_source_does(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["generate", "--help"])
    lines = [line.strip("│ ") for line in capsys.readouterr().out.splitlines()]
    start = next(k for k, line in enumerate(lines) if "--scenes" in line)
    *full, _ = lines[start + 1 : next(k for k in range(start, len(lines)) if "--episodes-file" in lines[k])]
    assert len(full) > 2
    for line, following in zip(full, [*full[1:], lines[start + 1 + len(full)]], strict=True):
        assert len(line) + len(following.split()[0]) >= max(map(len, full)) - 8, f"{line} is cut short"


def test_options_of_other_tasks_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"(?s)social_nav: --skills \(of rearrange and language\).*H3-OPTION-079"):
        parse(
            ["generate", "social_nav", "--skills", "learned", "--agents", "robot,human", "-o", "x"], COMMANDS, about=""
        )
    with pytest.raises(InputError, match=r"(?s)social_nav: skills \(of rearrange and language\).*H3-OPTION-076"):
        h3data.generate("social_nav", tmp_path, skills="learned")
    parse(["generate", "my_tasks:Mine", "--skills", "learned", "-o", "x"], COMMANDS, about="")


def test_a_list_option_before_the_positional_argument() -> None:
    view = parse(["view", "--camera", "robot_arm", "--camera", "top_down", "ep.mcap"], COMMANDS, about="").command
    assert isinstance(view, View)
    assert (view.cameras, view.recording) == (("robot_arm", "top_down"), Path("ep.mcap"))
    imported = parse(["import", "--assets", "a", "file.json", "-o", "rec"], COMMANDS, about="").command
    assert isinstance(imported, Import)
    assert (imported.assets, imported.paths) == ((Path("a"),), (Path("file.json"),))


# --- job files ---------------------------------------------------------------------------------------------------------
def test_a_job_file_gives_options_and_the_command_line_wins(tmp_path: Path) -> None:
    job = tmp_path / "job.toml"
    job.write_text('task = "wander"\nepisodes = 20\nhuman-speed = 1.5\nmcap = true\nset = ["a=1", "b=2"]\nout = "ds"\n')
    parsed = parse(["generate", "--config", str(job), "--episodes", "3", "--quiet"], COMMANDS, about="")
    assert parsed.quiet
    command = parsed.command
    assert isinstance(command, Generate)
    assert (command.task, command.episodes, command.human_speed, command.mcap) == ("wander", 3, 1.5, True)
    assert (command.overrides, command.out) == (("a=1", "b=2"), Path("ds"))


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("epsodes = 3", r"(?s)'epsodes'.*Did you mean 'episodes'.*H3-OPTION-064"),
        ("episodes = [1, 2]", r"(?s)'episodes'.*2.*H3-OPTION-061"),
        ('mcap = "yes"', r"(?s)'mcap'.*'yes'.*H3-OPTION-065"),
        ("episodes = true", r"(?s)'episodes'.*True.*H3-OPTION-060"),
        ("episodes = 1.5", r"(?s)--episodes: expected a whole number, got '1\.5'.*H3-OPTION-073"),
        ("episodes = ", "H3-OPTION-063"),
        (None, "H3-OPTION-062"),
    ],
)
def test_a_bad_job_file_is_refused(text: str | None, says: str, tmp_path: Path) -> None:
    job = tmp_path / "job.toml"
    if text is not None:
        job.write_text(text)
    with pytest.raises(InputError, match=says):
        parse(["generate", "wander", "-o", "x", f"--config={job}"], COMMANDS, about="")


def test_episodes_go_round_the_scenes_of_several_names() -> None:
    words = "generate wander --scenes small:7,h3-homes/val#0 --scene small:2 --episodes 4 -o x"
    command: Any = parse(words.split(), COMMANDS, about="").command
    assert [job.scene for job in command.jobs()] == ["small:7", "h3-homes/val#0", "small:2", "small:7"]


def test_a_dry_run_writes_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "ds"
    assert main(["generate", "wander", "--episodes", "5", "--homes", "2", "--dry-run", "-o", str(out)]) == 0
    told = capsys.readouterr().out
    assert told.startswith("Would play 5 episodes of wander")
    assert "in 2 scenes: small:0, small:1" in told
    assert not out.exists()


def test_a_plan_of_a_billion_episodes_makes_none_of_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    made, job = [], Choices.job

    def counting(self: Choices, *arguments: Any, **options: Any) -> Job:
        made.append(arguments)
        assert len(made) < 100
        return job(self, *arguments, **options)

    monkeypatch.setattr(Choices, "job", counting)
    options = ("--episodes", f"{10**9}", "--homes", "2", "--max-steps", "7", "--dry-run", "--json")
    assert main(["generate", "wander", *options, "-o", str(tmp_path / "ds")]) == 0
    plan = json.loads(capsys.readouterr().out)["plan"]
    assert (plan["episodes"], plan["most_steps"]) == (10**9, 7 * 10**9)
    assert plan["scenes"] == ["small:0", "small:1"]
    assert main(["generate", "wander", "--episodes", f"{10**30}", "--dry-run", "-o", str(tmp_path / "ds")]) == 2
    assert "--episodes must be at most" in capsys.readouterr().err


def test_episodes_are_the_same_whenever_they_are_made() -> None:
    jobs = make_jobs(Choices(task="wander", human="any"), "small", episodes=7, homes=3, seed=4)
    every = list(jobs)
    assert len(every) == len(jobs) == 7
    assert [job.scene for job in every] == [f"small:{k % 3}" for k in range(7)]
    assert (list(jobs[2:]), jobs[-1], jobs[3]) == (every[2:], every[-1], every[3])
    with pytest.raises(IndexError):
        jobs[7]


@pytest.mark.parametrize("shell", ["bash", "zsh"])
def test_completion_scripts_know_commands_and_options(shell: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["completion", shell]) == 0
    script = capsys.readouterr().out
    assert "rerender" in script
    assert "spawn-distance" in script or "spawn_distance" in script


def test_the_bash_script_completes(capsys: pytest.CaptureFixture[str]) -> None:
    bash = shutil.which("bash")
    if bash is None:
        pytest.skip("needs bash")
    main(["completion", "bash"])
    ask = "COMP_WORDS=(h3data rere); COMP_CWORD=1; _shtab_h3data; echo ${COMPREPLY[@]}"
    script = f"{capsys.readouterr().out}\n{ask}"
    answer = subprocess.run([bash, "-c", script], capture_output=True, text=True, check=False)
    assert answer.stdout.split() == ["rerender"], answer.stderr


def test_control_characters_never_reach_the_terminal(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info", str(tmp_path / "a\x1b[2Jb\u202e.mcap")]) == 2
    error = capsys.readouterr().err
    assert "\x1b" not in error
    assert "\u202e" not in error
    assert "a\\x1b[2Jb\\u202e.mcap" in error


def test_the_version(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["--version"])
    assert stop.value.code == 0
    assert capsys.readouterr().out.startswith("h3data ")


def test_help_before_parsing_changes_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    before = dict(Export.__annotations__)
    with pytest.raises(SystemExit):
        main(["export", "--help"])
    assert before == Export.__annotations__
    script = """
import sys
from contextlib import suppress
from h3data_pipelines.cli import main
with suppress(SystemExit):
    main(["export", "--help"])
code = main(["export", "a", "--to", "b", "-o", "c"])
assert "pandas" not in sys.modules, "commands start half a second later with pandas"
raise SystemExit(code)
"""
    said = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert said.returncode == 2
    assert "Cannot export to 'b'." in said.stderr


def test_the_option_names_every_set_of_rules() -> None:
    for name in ("social_nav", "rearrange", "wander"):
        assert set(get_args(RuleSet)) == set(find_task(name).Spec.rule_sets)


SHELL_AND_PYTHON = [
    ("--resume goes on, --force replaces it: x", "resume=True goes on, force=True replaces it: x"),
    ("or another -o: x", "or another out: x"),
    ("--episodes must be at least 1, got -4.", "episodes must be at least 1, got -4."),
    ("the same command with --resume goes on", "the same call with resume=True goes on"),
    ("Hint: --assets DIR or H3DATA_ASSETS", "Hint: assets=DIR or H3DATA_ASSETS"),
    ("h3data motion import --seed 3 makes one; --seed 3 not", "h3data motion import --seed 3 makes one; seed=3 not"),
    ("--unknown stays", "--unknown stays"),
]
PYTHON_AND_SHELL = [
    ("resume=True goes on, overwrite=True replaces it: x", "--resume goes on, --force replaces it: x"),
    ("Hint: a larger max_steps=, or another home.", "Hint: a larger --max-steps, or another home."),
    (
        "give assets=[DIR]; or leave out with allow_missing=True.",
        "give --assets DIR; or leave out with --allow-missing.",
    ),
    ("--set max_steps=900, max_steps=... or strict=True", "--set max_steps=900, max_steps=... or strict=True"),
    ("the file walk_seed=3.mcap and x.seed=True", "the file walk_seed=3.mcap and x.seed=True"),
]


@pytest.mark.parametrize(("shell", "python"), SHELL_AND_PYTHON)
def test_python_hears_no_flags(shell: str, python: str) -> None:
    assert in_python_words(shell, Generate) == python


@pytest.mark.parametrize(("python", "shell"), PYTHON_AND_SHELL)
def test_the_shell_hears_no_parameters(python: str, shell: str) -> None:
    assert in_shell_words(python, Generate) == shell


def test_a_positional_output_is_not_called_o() -> None:
    assert in_shell_words("or choose another -o: x", Convert) == "or choose another OUT: x"


def test_messages_below_the_commands_name_no_flags() -> None:
    """They reach users of Python, too; the command line translates them (`in_shell_words`)."""
    found = []
    for file in (
        p for package in ("h3data", "sim_kinematic", "pipelines/h3data_homes") for p in Path(package).rglob("*.py")
    ):
        if Path("h3data/commands") in file.parents:
            continue  # what commands themselves say
        text = file.read_text(encoding="utf-8")
        for node in ast.walk(ast.parse(text)) if "--" in text else ():
            if isinstance(node, ast.Raise) and node.exc is not None:
                said = "".join(
                    c.value for c in ast.walk(node.exc) if isinstance(c, ast.Constant) and isinstance(c.value, str)
                )
                said = re.sub(r"(h3data|pip) [a-z]+ [^.]*([.]{3} --[a-z]+)?|--unit-m of h3data motion import", "", said)
                found += [f"{file}:{node.lineno}" for _ in re.findall(r"(?<![\w-])--[a-z]", said)]
    assert not found


@pytest.mark.parametrize("words", ["generate", "play", "train", "rerender", "evaluate"])
def test_no_help_offers_none(words: str, capsys: pytest.CaptureFixture[str]) -> None:
    """None only means that an option is not given."""
    with pytest.raises(SystemExit):
        main([words, "--help"])
    said = capsys.readouterr().out
    assert "{None" not in said
    assert words not in ("generate", "train") or "{natural,paper}" in said or "{fast,paper,tiny}" in said


@pytest.mark.parametrize(
    "words",
    [
        "generate social_nav -o x --scenes smal:3",
        "generate social_nav -o x --policy rollout_exprt",
        "generate social_nav -o x --human femal_0",
        "generate social_nav -o x --set max_step=9",
        "export a --to lerobt -o b",
        "evaluate social_nav -o x --policies rollout_exprt",
    ],
)
def test_what_was_meant_is_said_alone(words: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(words.split()) == 2
    said = capsys.readouterr().err
    assert "Did you mean '" in said
    assert "Expected" not in said
    assert len(said) < 160


def test_a_table_of_options_says_what_was_meant_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "job.toml").write_text("episods = 3")
    assert main(["generate", "social_nav", "-o", "x", "--config", str(tmp_path / "job.toml")]) == 2
    assert "Did you mean 'episodes'?" in capsys.readouterr().err


@pytest.mark.parametrize("words", ["metrics A B --paired", "metrics A --paired B", "metrics --paired A B"])
def test_options_may_stand_between_the_values_of_a_list(words: str) -> None:
    command: Any = parse(words.split(), COMMANDS, about="").command
    assert command.recordings == (Path("A"), Path("B"))
    assert command.paired
    with pytest.raises(InputError, match=r"(?s)'--pair'.*H3-OPTION-067"):
        parse(["metrics", "A", "--pair", "B"], COMMANDS, about="")


def test_export_to_habitat_says_what_exports_there(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["export", "a.mcap", "--to", "habitat", "-o", "b"]) == 2
    assert "`h3data scenes export` writes scenes for Habitat" in capsys.readouterr().err


def test_evaluations_take_another_robot(capsys: pytest.CaptureFixture[str]) -> None:
    request = EvaluationRequest(
        task="social_nav", policies=("stand_still",), scenes=("small",), episodes=1, robot="lift_arm"
    )
    assert [job.base.robot for job in request.jobs()] == ["lift_arm"]
    assert request.jobs()[0].to_json()["episode"]["robot"] == "lift_arm"
    assert main(["evaluate", "skill", "--robot", "quad_arm", "-o", "x"]) == 2
    assert "no options of skill: --robot (of social_nav, rearrange and " in capsys.readouterr().err


def test_the_demo_lists_what_it_wrote(tmp_path: Path) -> None:
    (tmp_path / "dataset").mkdir()
    summary = {
        "steps": 9,
        "seconds_of_life": 0.3,
        "ended": "limit",
        "wall_s": 1,
        "files": {"metrics.json": 812, "dataset": 2_250_000},
    }
    lines = demo._text(tmp_path, summary, "").splitlines()
    assert [line.split() for line in lines[1:3]] == [["metrics.json", "0.8", "kB"], ["dataset/", "2.2", "MB"]]
