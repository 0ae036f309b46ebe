"""Whom a choice means: the same wherever something plays."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

import h3data
from h3data.errors import InputError
from h3data_pipelines.jobs.evaluation_runs import EvaluationRequest
from sim_kinematic.policies.assignment import AssignedPolicy, PolicyMaker, make_policy, resolve_policy
from sim_kinematic.policies.policy import External, Still, Velocity
from sim_kinematic.tasks.registry import find_task
from sim_kinematic.tasks.sources import EpisodeSource
from sim_kinematic.tasks.wander import Wander


class Gallery(Wander):
    """A task whose policies are in no table."""

    name = "gallery"

    def named_policy(self, kind: str, name: str, spec: Any) -> PolicyMaker | None:
        if not name.startswith("statue_"):
            return None
        if spec is not None and not name[7:].isdigit():
            raise InputError(f"No statue has the number {name[7:]}.")
        return lambda episode, number: AssignedPolicy(Still(), name, kind)


GALLERY = f"{__name__}:Gallery"


def test_what_a_task_names_itself_is_known_wherever_something_plays(tmp_path: Path) -> None:
    recording = h3data.simulate(Gallery, "small:1", agents={"robot": "statue_1", "human": "statue_2"}, max_steps=5)
    assert len(recording) == 5
    made = h3data.generate(
        Gallery, tmp_path / "ds", scenes="small:1", episodes=1, policies="statue_1", partners="statue_2", max_steps=5
    )
    assert not made.failed
    request = EvaluationRequest(
        task=GALLERY, scenes=("small:1",), episodes=1, policies=("statue_1", "wander"), partners=("statue_2",)
    )
    assert [job.policies for job in request.jobs()] == [("statue_1", "wander")]
    assert h3data.make(Gallery, "small:1", partner="statue_2").reset(seed=1)


@pytest.mark.parametrize("name", ["statue_x", "statu_1"])
def test_what_no_task_names_is_refused_before_anything_plays(name: str, tmp_path: Path) -> None:
    said = "No statue has the number x" if name == "statue_x" else "(?s)'statu_1'.*H3-POLICY-002"
    with pytest.raises(InputError, match=said):
        h3data.generate(Gallery, tmp_path / "ds", scenes="small:1", policies=name)
    with pytest.raises(InputError, match=said):
        EvaluationRequest(task=GALLERY, scenes=("small:1",), policies=(name,), episodes=1).jobs()
    with pytest.raises(InputError, match=said):
        h3data.make(Gallery, "small:1", partner=name)
    assert not (tmp_path / "ds").exists()


def test_every_form_of_a_choice_makes_a_policy() -> None:
    episode = EpisodeSource(find_task("wander"), "small:1").sample(1, 0)

    def ahead(view: Any, base: Any) -> Velocity:
        return Velocity(1.0, 0.0)

    still = Still()
    for choice, name in (
        (still, "Still"),
        (Still, "Still"),
        (ahead, "ahead"),
        ("still", "still"),
        (External(), "external"),
        ("sim_kinematic.policies.policy:Still", "sim_kinematic.policies.policy:Still"),
    ):
        made = make_policy(find_task("wander"), episode, 0, choice)
        assert (made.name, made.kind) == (name, "robot")
        assert hasattr(made.policy, "act") or isinstance(made.policy, External)
    maker = resolve_policy(find_task("wander"), "robot", Still)
    assert maker(episode, 0).policy is not maker(episode, 0).policy, "each episode has its own"
    with pytest.raises(InputError, match=r"(?s)3.*H3-POLICY-001"):
        make_policy(find_task("wander"), episode, 0, 3)  # type: ignore[arg-type]
