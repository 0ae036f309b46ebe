"""What `h3data generate` is about to simulate."""

from pathlib import Path

import pytest
from h3data_pipelines.jobs.episode_jobs import Changes

from h3data.bodies import humanoid_names
from h3data_pipelines.commands.generate import Generate


def test_any_body_is_drawn_by_the_episodes_seed() -> None:
    drawn = [Changes(policy="stand_still", human="any").body(seed) for seed in range(200)]
    assert set(drawn) == set(humanoid_names())
    assert drawn == [Changes(policy="random", human="any").body(seed) for seed in range(200)]


@pytest.mark.parametrize("human", [None, "male_1"])
def test_a_named_body_is_everybodys(human: str | None) -> None:
    assert Changes(policy="stand_still", human=human).body(3) == human


def test_bodies_of_a_dataset_do_not_depend_on_how_many_episodes_are_asked_for() -> None:
    def bodies(episodes: int) -> list[str | None]:
        jobs = Generate(task="social_nav", out=Path("ds"), episodes=episodes, human="any", homes=2).jobs()
        return [job.human for job in jobs]

    assert len(set(bodies(12))) > 3
    assert bodies(12)[:5] == bodies(5)
