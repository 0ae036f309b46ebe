"""Reports: what is there is shown beside the paper's numbers, what is not there is said, and nothing can break out."""

from __future__ import annotations

import json
import pickle
import re
import uuid
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from h3data.commands.executors import LostShardError
from h3data.errors import InputError
from h3data.geometry import ground_pose
from h3data.metrics import measure_files
from h3data.metrics.batch import Part
from h3data.metrics.paper.published import published_results
from h3data.plugins import Registry
from h3data.recording import DatasetWriter, Recording, open_recording
from h3data.recording.records import STEP_NS, Agent, Episode
from h3data_pipelines.cli import main
from h3data_training.curve import save_curve
from h3data_viewers.html_report.data import gather, same_episodes
from h3data_viewers.html_report.paper import social_nav_table
from h3data_viewers.html_report.pictures import highlights, key_rows
from h3data_viewers.html_report.reading import Found, lost_part
from h3data_viewers.html_report.report import Report, make_report
from h3data_viewers.html_report.svg import Svg, ticks
from h3data_viewers.html_report.tables import (
    Cell,
    Column,
    Row,
    Section,
    Table,
    cut,
    number,
    to_latex,
    to_markdown,
)
from h3data_viewers.templates import environment, render
from sim_kinematic.policies.learned import SHIPPED_PARTNERS

ROBOT, HUMAN = Agent(name="spot", kind="robot"), Agent(name="alex", kind="human")
POLICIES = ("heuristic_expert", "stand_still")
HOSTILE = "<script>alert(1)</script>&\"'><img src=x onerror=alert(2)>"


@pytest.fixture(scope="session")
def runs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Three short episodes of each policy, the same episodes for both."""
    folder = tmp_path_factory.mktemp("report")
    for policy in POLICIES:
        said = main(
            [
                "generate",
                "social_nav",
                "--episodes",
                "3",
                "--homes",
                "1",
                "--max-steps",
                "60",
                "--seed",
                "4",
                "--policy",
                policy,
                "-o",
                str(folder / policy),
            ]
        )
        assert said == 0
    return {policy: folder / policy for policy in POLICIES}


@pytest.fixture(scope="session")
def report(runs: dict[str, Path]) -> Report:
    return make_report(runs.values(), pictures=2)


def test_a_report_shows_how_far_it_is(
    runs: dict[str, Path], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("h3data.progress.LINE_EVERY_S", 0.0)
    make_report(runs.values(), pictures=2)
    said = capsys.readouterr().err
    assert "read and measure: 3 of 6 episodes" in said
    assert "picture episodes: 1 of 2 episodes" in said
    assert main(["metrics", str(runs[POLICIES[0]])]) == 0
    assert "measure: 3 episodes" in capsys.readouterr().err


def write(folder: Path, recordings: list[Recording]) -> Path:
    with DatasetWriter(folder) as writer:
        for recording in recordings:
            writer.add(recording)
    return folder


def tidy(steps: int, *, solved: bool = True, hit: bool = False, **info: object) -> Recording:
    """A rearrangement of object 7 by the robot and 9 by the person, done after ``steps``."""
    at_goal = np.zeros((steps, 2), np.bool_)
    at_goal[-1] = [True, solved]
    collision = np.zeros(steps, np.bool_)
    collision[-1] = hit
    still = ground_pose(np.zeros((steps, 2)), np.zeros(steps)).astype(np.float32)
    said = {"max_steps": 2000, "solo_steps": 60, "goal_objects": [7, 9], **info}
    name = uuid.uuid4().hex[:8]
    return Recording(
        episode=Episode(uid=name, episode_id=name, task="rearrange", scene=str(info.get("home", "x")), info=said),
        agents=(ROBOT, HUMAN),
        columns={
            "time_ns": np.arange(1, steps + 1) * STEP_NS,
            "agent_0.base_pose": still,
            "agent_1.base_pose": still,
            "agent_0.grasp_body": np.where(np.arange(steps) < steps - 1, 7, -1).astype(np.int32),
            "agent_1.grasp_body": np.where(np.arange(steps) < steps - 1, 9, -1).astype(np.int32),
            "metrics.at_goal": at_goal,
            "metrics.collision": collision,
        },
    )


class Page(HTMLParser):
    """What a browser would see: tags, attributes, ids, and whether elements are closed in order."""

    VOID = frozenset({"meta", "img", "br", "rect", "line", "circle", "path", "use", "image"})

    def __init__(self, html: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.open: list[str] = []
        self.text = ""
        self.feed(html)
        assert not self.open, self.open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in self.VOID or (tag in ("circle",) and not self.get_starttag_text().endswith("/>")):  # type: ignore[union-attr]
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self.open
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data

    def of(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.tags if name == tag]


# --- the page ---------------------------------------------------------------------------------------------------------
def test_the_page_needs_nothing_else(report: Report) -> None:
    page = Page(report.html)
    for tag, attributes in page.tags:
        for name in ("src", "href"):
            value = attributes.get(name) or ""
            assert not value or value.startswith(("#", "data:image/jpeg;base64,")), (tag, value[:80])
        assert not any(name.startswith("on") for name in attributes)
    assert "url(" not in report.html
    assert "@import" not in report.html
    assert len(page.of("script")) == 1
    assert len(report.html) < 1_000_000
    assert not re.search(r"[0-9] %", page.text), "percentages as in English"


def test_links_and_drawings_point_to_what_is_there(report: Report) -> None:
    page = Page(report.html)
    ids = [a["id"] for _, a in page.tags if "id" in a]
    assert len(ids) == len(set(ids))
    wanted = [a["href"] for tag in ("a", "use") for a in page.of(tag)]
    assert wanted
    assert {str(href)[1:] for href in wanted} <= set(ids)


def test_pictures_and_tables_can_be_heard(report: Report) -> None:
    page = Page(report.html)
    assert all(a.get("alt") for a in page.of("img"))
    assert all(a.get("aria-label") or a.get("aria-hidden") for a in page.of("svg"))
    assert all(a.get("scope") for a in page.of("th"))
    assert len(page.of("caption")) == len(page.of("table")) > 0


def test_the_page_holds_the_values_of_the_metrics_command(runs: dict[str, Path], report: Report) -> None:
    for run in report.data.runs:
        summary = measure_files([runs[run.policy]]).summary()
        row = next(r for r in report.tables[0].sections[0].rows if r.name == run.name)
        assert [c.value for c in row.cells] == pytest.approx([s.mean for s in summary.values()], nan_ok=True)
        s = summary["S"]
        assert row.cells[0].text == f"{s.mean:.2f} [{s.low:.2f}, {s.high:.2f}]"
        assert f"{s.mean:.2f}" in report.html


@pytest.mark.slow
def test_the_same_recordings_give_the_same_page(runs: dict[str, Path], report: Report) -> None:
    assert make_report(runs.values(), pictures=2).html == report.html


@pytest.mark.slow
def test_workers_elsewhere_give_the_same_page(runs: dict[str, Path], report: Report) -> None:
    def spread(work: Callable[[Part], Found], parts: Sequence[Part]) -> Iterator[Found]:
        for part in parts:
            yield pickle.loads(pickle.dumps(pickle.loads(pickle.dumps(work))(part)))

    assert make_report(runs.values(), pictures=2, spread=spread).html == report.html


def test_what_no_worker_survives_is_listed(runs: dict[str, Path]) -> None:
    def spread(work: Callable[[Part], Found], parts: Sequence[Part]) -> Iterator[Found]:
        yield from map(work, parts[:-1])
        yield lost_part(parts[-1], LostShardError("its node died"))

    data = gather(runs.values(), spread=spread)
    (names,) = data.unmeasured.values()
    assert data.unmeasured == {"its node died": names}
    assert all(name.startswith(f"{list(runs.values())[-1].name}#") for name in names)
    assert len(data.runs) == len(runs) - 1


def test_key_frames_are_embedded(report: Report) -> None:
    frames = [a for a in Page(report.html).of("img") if str(a["src"]).startswith("data:image/jpeg")]
    chosen = highlights(report.data.runs, 2)
    assert len(frames) == sum(len(key_rows(h.episode)) for h in chosen)
    assert {h.kind for h in highlights(report.data.runs, 6)} == {"worst", "best"}
    everything = highlights(report.data.runs, 100)
    assert len({id(h.episode) for h in everything}) == len(everything) == 6


# --- the paper --------------------------------------------------------------------------------------------------------
def test_published_numbers_are_those_of_the_paper() -> None:
    paper = published_results()
    expert = paper.social_nav.row_of("heuristic_expert")
    assert expert is not None
    assert {k: v[0] for k, v in expert.values.items()} == {
        "S": 1.0,
        "SPS": 0.97,
        "F": 0.51,
        "CR": 0.52,
        "BYR": 0.24,
        "TD": 2.56,
        "FD": 1.72,
    }
    assert [row.name for row in paper.rearrange.rows][:2] == ["Learn-Single", "Plan-Pop 1"]
    assert paper.rearrange.rows[0].train["RE"] == (159.2, 1.0)
    assert paper.rearrange.rows[0].zsc["SR"] == (50.94, 39.55)
    solo, single, population = (row.values for row in paper.hitl.rows)
    # The paper's other tables follow from its estimated means.
    assert single["RE"][0] == pytest.approx(100 * solo["TS"][0] / single["TS"][0], abs=0.01)
    assert population["RE"][0] == pytest.approx(100 * solo["TS"][0] / population["TS"][0], abs=0.01)
    differences = [
        population["TS"][0] - single["TS"][0],
        solo["TS"][0] - single["TS"][0],
        solo["TS"][0] - population["TS"][0],
    ]
    assert [row.difference for row in paper.contrasts.rows] == pytest.approx(differences, abs=0.015)
    for row in paper.rearrange.rows:
        assert {*row.train} == {*row.zsc} == {"SR", "RE", "CR", "RC"}


def test_published_numbers_stand_beside_ours(report: Report) -> None:
    table = report.tables[0]
    assert table.sections[1].published
    assert table.sections[1].rows[0].cells[1].text == "0.97"
    assert table.sections[0].rows[0].cells[1].small == "paper 0.97"
    assert table.sections[0].rows[1].cells[1].small == ""


# --- what there is ----------------------------------------------------------------------------------------------------
def test_what_is_missing_is_said_and_has_no_table(report: Report) -> None:
    said = " ".join(report.missing)
    for what in ("rearrangement", "Human-in-the-loop", "Learning curves"):
        assert what in said
    assert {t.key for t in report.tables} == {"social_nav", "paired_1"}
    assert "table-rearrange" not in report.html


def test_numbers_come_before_what_is_missing(report: Report) -> None:
    assert report.html.index('id="table-social_nav"') < report.html.index("Not in this report</h2>")


def test_the_robot_has_the_colour_of_its_run_in_every_drawing(report: Report) -> None:
    cards = re.findall(r'<article class="card">.*?</article>', report.html, re.DOTALL)
    assert len(cards) == 2
    for card in cards:
        (chip,) = re.findall(r'class="chip (s\d)"', card)
        assert set(re.findall(r'class="(?:way|line|start|end) (s\d)"', card)) == {chip}
        assert "person-way" in card
    assert "robot-way" not in report.html


def test_the_command_that_made_a_report_is_its_last_line(runs: dict[str, Path], tmp_path: Path) -> None:
    words = ["report", str(runs["stand_still"]), "--pictures", "0", "--title", "A & B", "-o", str(tmp_path / "r.html")]
    assert main(words) == 0
    (command,) = re.findall(r"<footer>.*?<code>(.*?)</code>", (tmp_path / "r.html").read_text(encoding="utf-8"))
    assert command == "h3data report stand_still --title &#39;A &amp; B&#39; --pictures 0 -o r.html"


def test_pairs_need_the_same_scene_and_seed(runs: dict[str, Path], tmp_path: Path) -> None:
    other = tmp_path / "other"
    assert (
        main(
            [
                "generate",
                "social_nav",
                "--policy",
                "heuristic_expert",
                "--episodes",
                "3",
                "--homes",
                "1",
                "--max-steps",
                "30",
                "--seed",
                "5",
                "-o",
                str(other),
            ]
        )
        == 0
    )
    data = gather([*runs.values(), other])
    first, second, third = data.runs
    assert same_episodes(first, second)
    assert not same_episodes(first, third), "the ids are equal, the seeds are not"
    assert first.name == "heuristic_expert (heuristic_expert)"
    assert third.name == "heuristic_expert (other)"


def test_rearrangement_by_population_and_partner(tmp_path: Path) -> None:
    ds = write(
        tmp_path / "ds",
        [
            *(tidy(30, policy="learn_single", partner="a", population="train-pop") for _ in range(3)),
            *(tidy(60, policy="learn_single", partner=p, population="zsc-pop", solved=p == "b") for p in "bc"),
        ],
    )
    report = make_report([ds], pictures=0)
    table = next(t for t in report.tables if t.key == "rearrange")
    assert table.groups == [("Train-pop-eval", 4), ("ZSC-pop-eval", 4)]
    assert [c.value for c in table.sections[0].rows[0].cells[:2]] == [100.0, 200.0]
    assert table.sections[0].rows[0].cells[4].value == 50.0
    assert 'class="heat"' in report.html
    heat = next(t for t in report.tables_of_partners if t.title == "SR by partner")
    assert [c.head for c in heat.columns] == ["a", "b", "c", "ZSC mean"]  # by population, not by the alphabet alone
    assert heat.groups == [("Training partners", 1), ("Zero-shot partners", 2), ("", 1)]
    assert [cell.text for cell in heat.sections[0].rows[0].cells] == [
        "100.0",
        "100.0",
        "0.0",
        "50.0",
    ]  # as in the table above
    assert heat.scale == ("0.0", "100.0, better")
    assert 'aria-label="Colours from 0.0 to 100.0, better"' in report.html
    assert "Social navigation: there are no episodes of it." in report.missing


def test_each_partner_that_shares_a_recording_belongs_to_its_own_population(tmp_path: Path) -> None:
    shared = tidy(30, policy="p", partner="plan_pop_1", population="train-pop", partners=["plan_pop_1", "object_1"])
    other = tidy(60, policy="p", partner="both", population="zsc-pop", partners=["both", "object_2", "still"])
    write(tmp_path / "e" / "recordings" / "000000", [shared, other])

    def groups() -> tuple[dict[str, list[str]], float]:
        report = make_report([tmp_path / "e"], pictures=0)
        found: dict[str, list[str]] = {}
        for episode in report.data.episodes:
            found.setdefault(episode.population, []).append(episode.partner)
        table = next(t for t in report.tables if t.key == "rearrange")
        return found, table.sections[0].rows[0].cells[5].value  # RE of the zero-shot population

    assert groups() == ({"train": ["plan_pop_1"], "zsc": ["object_1", "both", "object_2", "still"]}, 125.0)
    (tmp_path / "e" / "table.json").write_text(json.dumps({"job": {"task": "rearrange", "zsc": ["both"]}}))
    told, re = groups()
    assert told["zsc"] == ["both"]
    assert re == 100.0


def test_policies_of_several_training_seeds_are_one_row(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Mean and standard deviation of the means of each, as in the table of ``h3data evaluate``."""
    names = [f"weights:out/s{k}/policy.npz@{k:012x}" for k in range(3)]
    solved = {names[0]: (True, True), names[1]: (True, False), names[2]: (True, True, True, True)}
    write(
        tmp_path / "e" / "recordings" / "000000",
        [
            *(tidy(60, solved=done, policy=name, partner="a") for name, each in solved.items() for done in each),
            tidy(60, policy="expert", partner="b"),
        ],
    )

    def rows() -> dict[str, str]:
        report = make_report([tmp_path / "e"], pictures=0)
        table = next(t for t in report.tables if t.key == "rearrange")
        return {row.name: row.cells[0].text for row in table.sections[0].rows}

    assert len(rows()) == 4
    pattern = "weights:out/s*/policy.npz"
    report = make_report([tmp_path / "e"], pictures=0, seeds=[pattern])
    table = next(t for t in report.tables if t.key == "rearrange")
    pooled, expert = table.sections[0].rows
    assert pooled.name == pattern
    assert pooled.small == "8 episodes of 3 seeds, 1 partner"
    assert pooled.cells[0].text == "83.3 ± 28.9"  # of 100, 50 and 100, not of eight episodes
    assert "±" not in expert.cells[0].text
    assert "standard deviation" in table.caption
    heat = next(t for t in report.tables_of_partners if t.title.startswith("SR"))
    assert [cell.small for cell in heat.sections[0].rows[0].cells] == ["± 28.9, n = 8", ""]
    assert names[1] in report.html  # each episode says of which seed it is
    # an evaluation that was told a pattern needs no option
    told = [{"metric": "SR", "policies": pattern, "partner": "a", "seeds": [{"policy": name} for name in names]}]
    (tmp_path / "e" / "table.json").write_text(json.dumps({"job": {"task": "rearrange"}, "seeds": told}))
    assert rows()[pattern] == "83.3 ± 28.9"
    assert main(["report", str(tmp_path / "e"), "--pictures", "0", "-o", str(tmp_path / "r.html"), "--json"]) == 0
    run = json.loads(capsys.readouterr().out)["runs"][0]
    assert run["seeds"]["policies"] == names
    assert run["seeds"]["metrics"]["SR"]["deviation"] == pytest.approx(0.2887, abs=1e-4)
    with pytest.raises(InputError, match=r"(?s)'weights:other/\*'.*0.*expert.*H3-VIEW-010"):
        make_report([tmp_path / "e"], pictures=0, seeds=["weights:other/*"])


def test_long_names_are_cut_in_the_middle_and_whole_in_their_title(tmp_path: Path) -> None:
    home = "home_small_20200_area_m2_100.5_bedrooms_2_clutter_1.5"
    html = make_report([write(tmp_path / "ds", [tidy(30, home=home, policy="p")])], pictures=0).html
    assert f'<span title="{home}">home_small_20200_…ms_2_clutter_1.5</span>' in html
    assert cut("Mean over episodes", 12) == "Mean over e…"
    assert cut("weights:out/s10/policy.npz", 16) == "weights:…icy.npz"


def test_some_partners_of_the_zero_shot_population_are_none(tmp_path: Path) -> None:
    """As in the table of the evaluation, which has no such column then."""
    shared = tidy(30, policy="p", partners=["plan_pop_1", "object_1"])
    other = tidy(60, policy="p", partners=["both", *SHIPPED_PARTNERS])
    kept, bare = tmp_path / "kept", tmp_path / "bare"
    write(kept / "recordings" / "000000", [shared, other])
    (bare / "episodes").mkdir(parents=True)
    (bare / "table.json").write_text(json.dumps({"job": {"task": "rearrange"}}))
    rows = [
        {"index": 0, "policy": "p", "partner": partner, "values": {"SR": 1.0}}
        for partner in ("plan_pop_1", "object_1", "both", *SHIPPED_PARTNERS)
    ]
    (bare / "episodes" / "000000.json").write_text(json.dumps({"job": {"episode": {"seed": 1}}, "rows": rows}))
    for folder in (kept, bare):
        report = make_report([folder], pictures=0)
        assert {e.population for e in report.data.episodes} == {"train", ""}
        assert all("ZSC mean" not in {c.head for c in t.columns} for t in report.tables_of_partners)
    rows += [{**rows[0], "partner": partner} for partner in ("object_2", "still")]
    (bare / "episodes" / "000000.json").write_text(json.dumps({"job": {"episode": {"seed": 1}}, "rows": rows}))
    found = {e.partner for e in make_report([bare], pictures=0).data.episodes if e.population == "zsc"}
    assert found == {"both", "object_1", "object_2", "still", *SHIPPED_PARTNERS}
    del rows[3]  # one of the learned ones did not play
    (bare / "episodes" / "000000.json").write_text(json.dumps({"job": {"episode": {"seed": 1}}, "rows": rows}))
    found = {e.partner for e in make_report([bare], pictures=0).data.episodes if e.population == "zsc"}
    assert found == {"both", "object_1", "object_2", "still"}


def test_a_gfx_replay_is_said_to_be_taken_for_a_task(tmp_path: Path) -> None:
    replay = tidy(30)
    replay = replace(replay, episode=replace(replay.episode, task="gfx_replay"))
    assert "Taken for social_nav: a gfx-replay" in make_report([write(tmp_path / "ds", [replay])], pictures=0).html


def test_a_study_gives_estimated_means_and_contrasts(tmp_path: Path) -> None:
    random = np.random.default_rng(2)
    means = {"solo": 90, "learn_single": 60, "plan_pop3": 66}
    episodes = [
        tidy(
            int(random.poisson(mean)) + 2,
            condition=condition,
            participant=f"P{p}",
            policy=condition,
            home=f"home {p % 3}",
            hit=condition != "solo" and random.random() < 0.4,
        )
        for condition, mean in means.items()
        for p in range(6)
        for _ in range(4)
    ]
    report = make_report([write(tmp_path / "ds", episodes)], pictures=0)
    study, contrast = (next(t for t in report.tables if t.key == key) for key in ("hitl", "contrasts"))
    by_name = {row.name: [c.value for c in row.cells] for row in study.sections[0].rows}
    assert by_name["solo"][3] == 100.0
    assert by_name["learn_single"][3] == pytest.approx(150, rel=0.1)
    assert by_name["learn_single"][1] == pytest.approx(62, rel=0.1)
    assert by_name["solo"][0] == 0.0
    pairs = {row.name: row.cells for row in contrast.sections[0].rows}
    assert pairs["solo − learn_single"][0].value == pytest.approx(30, rel=0.2)
    assert pairs["solo − learn_single"][1].text == "< .0001"
    assert [row.name for row in study.sections[0].rows] == ["solo", "learn_single", "plan_pop3"]
    assert "rearrange" not in {t.key for t in report.tables}, "people are no population"


def test_rates_of_people_who_always_answer_alike_are_plain_shares(tmp_path: Path) -> None:
    """Six of nine people touch the robot in every episode, the others in none."""
    episodes = [
        tidy(20 + k, condition=condition, participant=f"P{p}", hit=p < 6, solved=p >= 6)
        for condition in ("complement", "plan_pop3")
        for p in range(9)
        for k in range(3)
    ]
    report = make_report([write(tmp_path / "ds", episodes)], pictures=0)
    study = next(t for t in report.tables if t.key == "hitl")
    assert [row.cells[0].text for row in study.sections[0].rows] == ["0.67 [0.48, 0.81]"] * 2
    assert any("CR: plain shares" in note and "always alike" in note for note in study.notes)


def test_without_the_package_of_studies_a_report_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    nothing: Registry[Callable[..., object]] = Registry("h3data.nothing", {}, what="section of reports")
    monkeypatch.setattr("h3data_viewers.html_report.report.SECTIONS", nothing)
    report = make_report([write(tmp_path / "ds", dispersed_study())], pictures=0)
    assert "rearrange" not in [table.key for table in report.tables], "all episodes are of participants"
    assert any("study in social rearrangement: Unknown section of reports 'study'" in why for why in report.missing)


def dispersed_study(*, task: str = "rearrange") -> list[Recording]:
    """Steps that vary much more than Poisson allows, with every third robot episode ended by a contact at step 5."""
    random = np.random.default_rng(5)
    episodes = []
    for condition, mean in {"solo": 120, "plan_pop3": 95}.items():
        for p in range(8):
            for k in range(6):
                steps = 5 if condition != "solo" and k % 3 == 2 else int(mean * random.lognormal(0, 0.5)) + 10
                recording = tidy(
                    steps,
                    solved=steps > 5,
                    hit=steps == 5,
                    condition=condition,
                    participant=f"P{p}",
                    home=f"home {p % 3}",
                )
                episodes.append(replace(recording, episode=replace(recording.episode, task=task)))
    return episodes


@pytest.mark.slow  # quick: tests/stats
def test_no_p_value_of_an_unsound_model_stands_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    ds = write(tmp_path / "ds", dispersed_study())
    report = make_report([ds], pictures=0)
    contrast = next(t for t in report.tables if t.key == "contrasts")
    assert [c.group for c in contrast.columns[::2]] == ["Poisson with an observation effect", "Poisson"]
    assert contrast.columns[3].head == "p (too small)"
    assert any("over-dispersed" in note for note in contrast.notes)
    study = next(t for t in report.tables if t.key == "hitl")
    steps = {row.name: row.cells[1].value for row in study.sections[0].rows}
    assert steps["plan_pop3"] > 60, "a contact at step 5 is no time to success"
    assert any("16 episodes without success are left out (0 under solo, 16 under plan_pop3)" in n for n in study.notes)
    assert main(["study", "fit", str(ds), "--json"]) == 0
    fitted = json.loads(capsys.readouterr().out)
    assert [m["sound"] for m in fitted["models"]] == [True, False]
    widths = [m["contrasts"][0]["high"] - m["contrasts"][0]["low"] for m in fitted["models"]]
    assert widths[0] > 3 * widths[1]
    assert fitted["estimates"]["TS"]["plan_pop3"]["mean"] == pytest.approx(steps["plan_pop3"])
    assert fitted["estimates"]["CR"]["solo"]["mean"] == 0
    assert main(["study", "fit", str(ds), "--failed", "limit", "--model", "poisson", "--json"]) == 0
    limited = json.loads(capsys.readouterr().out)
    assert [m["sound"] for m in limited["models"]] == [False, True]
    assert limited["estimates"]["TS"]["plan_pop3"]["mean"] > 500
    assert main(["study", "fit", str(ds), "-o", str(tmp_path / "s.json")]) == 0
    assert "Poisson with an observation effect" in capsys.readouterr().out


def test_automatic_and_human_orders_stand_beside_each_other(tmp_path: Path) -> None:
    people = write(
        tmp_path / "people",
        [
            tidy(steps + k, condition=condition, participant=f"P{k}", hit=condition == "plan_pop3")
            for condition, steps in {"solo": 90, "learn_single": 50, "plan_pop3": 70}.items()
            for k in range(6)
        ],
    )
    automatic = write(
        tmp_path / "auto",
        [
            tidy(steps + k, policy=policy, partner="a")
            for policy, steps in {"Learn-Single": 30, "Plan-Pop 3": 55}.items()
            for k in range(4)
        ],
    )
    report = make_report([people, automatic], pictures=0)
    ranks = next(t for t in report.tables if t.key == "ranks_rearrange")
    rows = {row.name: row.cells for row in ranks.sections[0].rows}
    assert rows["TS"][0].value == rows["RE"][1].value == 1
    assert rows["RE"][2].text.startswith("learn_single")
    means = {c: steps + 2.5 for c, steps in {"solo": 90, "learn_single": 50, "plan_pop3": 70}.items()}
    of_people = dict(part.rsplit(" ", 1) for part in rows["RE"][3].text.split(", "))
    measured = next(e.metrics.values["TS"] - 50 for e in report.data.episodes if e.condition == "learn_single")
    for name in ("learn_single", "plan_pop3"):
        want = 100 * (means["solo"] + measured) / (means[name] + measured)
        assert float(of_people[name]) == pytest.approx(want, abs=0.02), "RE, no steps"
    assert "Automatic and human evaluation" in report.html
    assert "ranks_rearrange" not in {t.key for t in make_report([people], pictures=0).tables}


@pytest.mark.slow
def test_any_task_can_be_studied(tmp_path: Path) -> None:
    ds = write(tmp_path / "ds", dispersed_study(task="juggling"))
    report = make_report([ds], pictures=0)
    assert {"juggling", "hitl_juggling", "contrasts_juggling"} <= {t.key for t in report.tables}
    assert "Human-in-the-loop study" in report.html


def test_learning_curves_of_a_log(runs: dict[str, Path], tmp_path: Path) -> None:
    ds = write(tmp_path / "ds", [open_recording(runs["stand_still"])[0]])  # type: ignore[list-item,index]
    (ds / "learning.csv").write_text("step,reward\n0,-1.5\n1000,2\n2000,nan\n3000,4\n")
    report = make_report([ds], pictures=0)
    assert 'id="learning"' in report.html
    assert not any("Learning curves" in line for line in report.missing)
    (ds / "learning.csv").write_text("update,reward\n0,1\n")
    with pytest.raises(InputError, match=r"(?s)step.*H3-VIEW-006"):
        make_report([ds], pictures=0)


def test_learning_curves_of_training_runs(runs: dict[str, Path], tmp_path: Path) -> None:
    """The table that `h3data train` writes, alone and beside a dataset."""
    run = tmp_path / "nav"
    run.mkdir()
    rows = [{"decisions": 1000 * k, "reward": float(k), "distance_m": 9.0 - k, "kl": 0.01 * k} for k in range(5)]
    save_curve(rows, run)
    alone = make_report([run], pictures=0)
    assert alone.data.curves["nav"]["step"].tolist() == [0, 1000, 2000, 3000, 4000]
    assert 'id="learning"' in alone.html
    assert "Learning curve of reward" in alone.html
    assert "mean distance between robot and person [m]" in alone.html
    together = make_report([runs["stand_still"], run], pictures=0)
    assert len(together.data.runs) == 1
    assert "Learning curve of reward" in together.html
    (run / "curve.parquet").write_bytes(b"PAR1")
    with pytest.raises(InputError, match=r"(?s)decisions.*H3-VIEW-009"):
        make_report([run], pictures=0)


def test_recordings_that_cannot_be_measured_are_counted(runs: dict[str, Path], tmp_path: Path) -> None:
    good = open_recording(runs["stand_still"])[0]  # type: ignore[index]
    assert isinstance(good, Recording)
    alone = replace(
        good,
        episode=replace(good.episode, uid="alone", episode_id="alone"),
        agents=good.agents[:1],
        columns={k: v for k, v in good.columns.items() if not k.startswith("agent_1")},
    )
    report = make_report([write(tmp_path / "ds", [good, alone])], pictures=1)
    assert list(report.data.unmeasured.values()) == [("ds#1",)]
    assert "1 not measured" in Page(report.html).text


def test_charts_show_only_what_is_known(runs: dict[str, Path], tmp_path: Path) -> None:
    good = open_recording(runs["stand_still"])[0]  # type: ignore[index]
    assert isinstance(good, Recording)
    columns = {k: v for k, v in good.columns.items() if k != "metrics.collision"}
    report = make_report([write(tmp_path / "ds", [replace(good, columns=columns)])], pictures=0)
    said = Page(report.html).text
    assert "Person found by then" in said
    assert "Person touched by then" not in said
    assert "touches the person in" not in said
    assert report.tables[0].sections[0].rows[0].cells[3].text == "–"


def test_the_nearest_person_is_shown(tmp_path: Path) -> None:
    def still(x: float) -> np.ndarray:
        return ground_pose(np.tile([x, 0.0], (60, 1)), np.zeros(60)).astype(np.float32)

    passing = still(3.0)
    passing[30, 0] = 0.75
    columns = {
        "time_ns": np.arange(1, 61) * STEP_NS,
        **{f"agent_{k}.base_pose": pose for k, pose in enumerate((still(0.0), still(2.0), passing))},
    }
    episode = Episode(
        uid=str(uuid.uuid4()), episode_id="e", task="point_goal", scene="none", info={"profile": "social"}
    )
    agents = (ROBOT, HUMAN, replace(HUMAN, name="kim"))
    path = write(tmp_path / "ds", [Recording(episode=episode, agents=agents, columns=columns)])
    (run,) = gather([path]).runs
    (shown,) = run.episodes
    assert shown.metrics.human == 2
    assert shown.distance_m.tolist() == [2.0, 2.0, 0.75, 2.0]
    assert np.diff(shown.nearest_at[:, 0]) == pytest.approx([0.75])
    page = make_report([path], pictures=1).html
    for part in (
        "Distance to the nearest person [m]",
        "nearest person: 0.75 m",
        'class="nearest"',
        "paths of robot and people",
    ):
        assert part in page
    assert page.count("track person-track") == 2 + 1  # both in the overview, and the farther one beside the nearest


def test_recordings_without_a_scene_still_have_plans(tmp_path: Path) -> None:
    report = make_report([write(tmp_path / "ds", [tidy(30, policy="x")])], pictures=2)
    assert 'class="floor"' in report.html


def test_one_is_not_many_and_plans_left_out_are_counted(tmp_path: Path) -> None:
    one = make_report([write(tmp_path / "one", [tidy(5, home="a")])], pictures=0)
    facts = re.findall(r"<b>([^<]+)</b><span>([^<]+)</span>", one.html)
    assert facts[:4] == [("1", "episode"), ("1", "run"), ("1", "scene"), ("5", "steps")]
    assert "scenes with most episodes" not in one.html
    four = make_report([write(tmp_path / "four", [tidy(5, home=home) for home in "abcd"])], pictures=0)
    assert "The 3 scenes with most episodes, of 4." in four.html


def test_paths_that_cannot_be_reported(runs: dict[str, Path], tmp_path: Path) -> None:
    for paths, message in (([], "H3-RENDER-079"), ([runs["stand_still"]] * 2, "H3-VIEW-004")):
        with pytest.raises(InputError, match=message):
            gather(paths)
    with pytest.raises(InputError, match="H3-RECORDING-049"):
        gather([tmp_path / "nothing"])


# --- hostile names ----------------------------------------------------------------------------------------------------
def test_names_cannot_break_out(runs: dict[str, Path], tmp_path: Path) -> None:
    good = open_recording(runs["heuristic_expert"])[0]  # type: ignore[index]
    assert isinstance(good, Recording)
    info = {**good.episode.info, "policy": HOSTILE, "partner": HOSTILE}
    hostile = [
        replace(
            good,
            episode=replace(
                good.episode, uid=str(k), episode_id=f"{k}{HOSTILE}", scene=HOSTILE, info={**info, "partner": p}
            ),
            agents=tuple(replace(a, name=HOSTILE + a.kind) for a in good.agents),
        )
        for k, p in enumerate((HOSTILE, "other"))
    ]
    folder = write(tmp_path / "<img src=x onerror=alert(3)>", hostile)
    (folder / "learning.csv").write_text("step,<b>bold</b>\n0,1\n1,2\n")
    plain = Page(make_report([runs["heuristic_expert"]], pictures=1).html)
    report = make_report([folder], title=HOSTILE, pictures=1)
    page = Page(report.html)
    assert {tag for tag, _ in page.tags} - {tag for tag, _ in plain.tags} <= {"b"}
    assert len(page.of("script")) == 1
    assert not any(name.startswith("on") for _, attributes in page.tags for name in attributes)
    assert all(str(a["src"]).startswith("data:") for a in page.of("img"))
    assert "alert(1)" in page.text
    for text in (report.to_markdown(), report.to_latex()):
        assert "<script" not in text
        assert "<img" not in text


@settings(max_examples=10)
@given(st.text(max_size=40))
@example("[")
@example("1.0 [0.5, 1.5]")
@example("a [b [c] <![CDATA[")
def test_any_text_stays_text(text: str) -> None:
    table = Table(
        key="k",
        title=text,
        caption=text,
        name_head=text,
        columns=(Column(head=text, hint=text),),
        sections=(Section(title=text, rows=(Row(name=text, cells=(Cell(text=text, small=text),)),)),),
        notes=(text,),
    )
    parts: Any = environment().get_template("html_report/page/parts.html").module
    page = Page(parts.data_table(table))
    assert {tag for tag, _ in page.tags} <= {
        "div",
        "table",
        "caption",
        "span",
        "thead",
        "tbody",
        "tr",
        "th",
        "td",
        "small",
        "ul",
        "li",
    }
    rows = [line for line in to_markdown(table).splitlines() if line.startswith("|")]
    assert len(rows) == 3 + bool(text)
    assert all(len(re.findall(r"(?<!\\)(?:\\\\)*\|", row)) == 3 for row in rows)
    body = to_latex(table)
    assert body.count(r"\\") == 2 + bool(text)
    assert not re.search(r"(?<!\\)[#%]", body)


@settings(max_examples=10)
@given(st.text(max_size=20))
@example(HOSTILE)
def test_any_text_of_a_drawing_stays_text(text: str) -> None:
    svg = Svg(10, 10, alt=text, css="plan", caption=text)
    svg.text(0, 0, text, "label", most=5)
    svg.circle(0, 0, 1, "dot", title=text)
    svg.add("use", "", href=text)
    parts: Any = environment().get_template("html_report/page/parts.html").module
    page = Page(parts.panels([svg]) + parts.legend([text]))
    there = {tag for tag, _ in page.tags}
    assert there <= {"div", "figure", "figcaption", "svg", "text", "title", "circle", "use", "ul", "li", "span"}


def test_a_name_without_a_value_is_an_error() -> None:
    with pytest.raises(jinja2.UndefinedError, match="title"):
        render("html_report/page/report.html")


# --- parts ------------------------------------------------------------------------------------------------------------
@given(st.floats(-1e6, 1e6), st.floats(1e-3, 1e6), st.integers(2, 8))
def test_ticks_are_round_and_inside(low: float, span: float, count: int) -> None:
    found = ticks(low, low + span, count)
    assert 1 <= len(found) <= count + 1
    assert all(low - 1e-6 * span <= t <= low + span * (1 + 1e-6) for t in found)
    assert np.allclose(np.diff(found), np.diff(found)[:1], rtol=1e-3)


def test_numbers_as_they_are_printed() -> None:
    assert [number(v) for v in (1.005, -0.004, -1.5, float("nan"), 0)] == ["1.00", "0.00", "−1.50", "–", "0.00"]
    assert [number(v, 1) for v in (159.24, -0.04)] == ["159.2", "0.0"]


def test_the_table_of_one_run_has_no_best(runs: dict[str, Path]) -> None:
    (run,) = gather([runs["heuristic_expert"]]).runs
    assert not any(c.strong for r in social_nav_table([run]).sections[0].rows for c in r.cells)


# --- the command ------------------------------------------------------------------------------------------------------
def test_the_command(runs: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, md, tex = (tmp_path / name for name in ("r.html", "t.md", "t.tex"))
    words = ["report", *map(str, runs.values()), "-o", str(out), "--markdown", str(md), "--latex", str(tex)]
    capsys.readouterr()
    assert main([*words, "--pictures", "0", "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["bytes"] == out.stat().st_size
    assert [run["name"] for run in said["runs"]] == list(POLICIES)
    assert said["runs"][0]["summary"]["S"]["count"] == 3
    assert "| heuristic\\_expert |" in md.read_text()
    assert r"\toprule" in tex.read_text()
    assert main([*words, "--pictures", "0"]) == 2, "the files are there"
    assert main([*words, "--pictures", "0", "--force"]) == 0
    assert main(["report", str(runs["stand_still"]), "-o", str(out), "--latex", str(out), "--force"]) == 2
    assert main(["report", str(runs["stand_still"]), "-o", str(tmp_path / "x.html"), "--pictures", "-1"]) == 2


@pytest.mark.slow
def test_replays_of_the_episodes_shown_lie_beside_the_report(
    runs: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "my report.html"
    words = ["report", str(runs["stand_still"]), "-o", str(out), "--pictures", "2", "--replays", "--json"]
    assert main(words) == 0
    said = json.loads(capsys.readouterr().out)
    names = [Path(path).name for path in said["replays"]]
    assert names == ["social_nav_1_worst.html", "social_nav_2_best.html"]
    links = re.findall(r'<a href="([^"]+)">Play this episode</a>', out.read_text(encoding="utf-8"))
    assert links == [f"my%20report_replays/{name}" for name in names]
    assert all((tmp_path / "my report_replays" / name).read_bytes().startswith(b"<!doctype html>") for name in names)
    out.unlink()
    assert main(words) == 2, "the replays are there"
    assert "my report_replays" in capsys.readouterr().err
    assert main([*words, "--force", "--pictures", "0"]) == 2
