"""Script for sets of homes: `datasets/h3-homes` or, with ``--set``, `h3-homes-v2` or `h3-homes-large`.

``python -m bake.home_sets --choose`` picks the homes of the three splits and writes them down; without ``--choose``
only the tables of the card are measured again. ``--split`` picks those of one split.

Sizes are spread evenly on a logarithmic scale, and the rooms follow from them. A seed is taken only if the home has no
faults (`h3data scenes validate`) and the episodes of the split can be sampled in it.
"""

from __future__ import annotations

import argparse
import logging
import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from h3data.builtin import builtin_root
from h3data.errors import SceneError
from h3data.files import part_file
from h3data.scene.open import NamedScene, named_scenes, open_free_space, open_scene
from h3data.scene.scene_sets import SceneEntry, SceneSet, SocialNavRules, read_scene_set
from h3data_homes import HomeSpec
from h3data_homes.spec import MAX_BATHROOMS, MAX_BEDROOMS, Preset, min_area_m2
from h3data_pipelines.assets.scene_reports import AGENT_HEIGHT_M, AGENT_RADIUS_M, scene_size, validate_scene
from h3data_pipelines.assets.set_episodes import set_episode
from sim_kinematic.tasks.rearrange.task import Rearrange

log = logging.getLogger(__name__)

LEAST_M2, MOST_M2, LARGEST_M2 = 64.0, 420.0, 846.0
"""Floor areas [m2] of the smallest home, of the largest but one, and of the largest, after the paper's benchmark homes
(69 and 846 m2)."""
MIDDLE_M2 = 136.0
"""Floor area of the paper's other benchmark home [m2], the smallest in `h3-homes-large`."""
TRIED_REARRANGEMENTS = 1
"""Number of rearrangement episodes that must be sampled successfully in a home of the second generation."""


@dataclass(frozen=True, kw_only=True)
class Split:
    """Number and sizes of the homes of a split (paper, appendix on scenes: 37 x 1,000, 12 x 100, 10 x 15)."""

    name: Literal["train", "val", "test"]
    homes: int
    episodes: int
    spawn_distance_m: float
    first_seed: int
    about: str
    set_name: str = "h3-homes"
    sizes_m2: tuple[float, float] = (LEAST_M2, MOST_M2)
    """Floor areas between which all homes but one lie; that one has `LARGEST_M2`."""
    generation: int = 1
    tried_episodes: int = 200
    """Largest number of episodes that must be sampled successfully in a home before it is accepted."""

    @property
    def rules(self) -> SocialNavRules:
        """Rules by which episodes are sampled in the homes of the split."""
        return SocialNavRules(episodes_per_scene=self.episodes, spawn_distance_m=self.spawn_distance_m)


SPLITS = (
    Split(name="train", homes=37, episodes=1000, spawn_distance_m=3.0, first_seed=10_000, about="37 homes to learn in"),
    Split(name="val", homes=12, episodes=100, spawn_distance_m=5.0, first_seed=20_000, about="12 homes to choose by"),
    Split(name="test", homes=10, episodes=15, spawn_distance_m=5.0, first_seed=30_000, about="10 homes to report on"),
)
_TEXTS = ("to train in", "to validate in", "to test in")
SETS = {
    "h3-homes": SPLITS,
    "h3-homes-v2": tuple(
        replace(
            s,
            set_name="h3-homes-v2",
            first_seed=s.first_seed + 100_000,
            generation=2,
            tried_episodes=3,
            about=f"{s.homes} homes {text}",
        )
        for s, text in zip(SPLITS, _TEXTS, strict=True)
    ),
    "h3-homes-large": tuple(
        replace(
            s,
            set_name="h3-homes-large",
            sizes_m2=(MIDDLE_M2, LARGEST_M2),
            first_seed=s.first_seed + 200_000,
            tried_episodes=3,
            about=f"{s.homes} large homes {text}",
        )
        for s, text in zip(SPLITS, _TEXTS, strict=True)
    ),
}
"""Splits of each set by its name."""


# --- choosing ---------------------------------------------------------------------------------------------------------
def wishes(split: Split) -> list[HomeSpec]:
    """Return the wanted homes, smallest first, with seeds 100 apart so that each has alternatives."""
    rng = np.random.Generator(np.random.Philox(split.first_seed))
    steps = (np.arange(split.homes - 1) + rng.uniform(0.2, 0.8, split.homes - 1)) / (split.homes - 1)
    least, most = split.sizes_m2
    areas = [*(least * (most / least) ** steps), LARGEST_M2]
    found = []
    for k, area in enumerate(areas):
        bedrooms = int(np.clip(round(area / 55 + rng.uniform(-0.6, 0.8)), 1, MAX_BEDROOMS - 2))
        bathrooms = int(np.clip(round(bedrooms * rng.uniform(0.5, 0.8)), 1, MAX_BATHROOMS - 2))
        while area < min_area_m2(bedrooms, bathrooms):
            bedrooms, bathrooms = (bedrooms - 1, bathrooms) if bedrooms > 1 else (1, bathrooms - 1)
        preset: Preset = "small" if area < 110 else "medium" if area < 300 else "large"
        clutter = float(rng.choice([0.6, 1.0, 1.0, 1.5]))
        spec = HomeSpec(
            seed=split.first_seed + 100 * k,
            preset=preset,
            area_m2=round(float(area), 1),
            bedrooms=bedrooms,
            bathrooms=bathrooms,
            clutter=clutter,
            generation=split.generation,
        )
        found.append(spec)
    return found


def chosen(split: Split) -> SceneSet:
    """Return the split with the first home without faults for each wanted home."""
    entries: list[SceneEntry] = []
    for k, wish in enumerate(wishes(split)):
        for more in range(100):
            entry = SceneEntry(id=f"{split.name}_{k:02d}", source=_eased(wish, more))
            fault = _fault(entry, split)
            if not fault:
                entries.append(entry)
                break
            log.info("%s, seed %d: %s", entry.id, wish.seed + more, fault)
        else:
            raise SceneError(f"No sound home for {wish} in 100 seeds.")
        log.info("%s: %s", entry.id, entry.source)
    return _set_of(split, tuple(entries))


def _eased(spec: HomeSpec, failures: int) -> HomeSpec:
    """Return the wish with the next seed, and with one bathroom less after every second failure."""
    bathrooms = max(1, (spec.bathrooms or 1) - failures // 2)
    return replace(spec, seed=spec.seed + failures, bathrooms=bathrooms)


def _set_of(split: Split, scenes: tuple[SceneEntry, ...]) -> SceneSet:
    return SceneSet(
        name=split.set_name,
        split=split.name,
        scenes=scenes,
        social_nav=split.rules,
        about=split.about,
        sha256="",
    )


def _fault(entry: SceneEntry, split: Split) -> str:
    """Return the reason why a home cannot be used; empty if it can."""
    try:
        problems = validate_scene(NamedScene(name=entry.id, source=entry.source))["problems"]
        if problems:
            return problems[0]["text"]
        for index in range(min(split.episodes, split.tried_episodes)):
            set_episode(_set_of(split, (entry,)), entry, index)
        if split.generation > 1:
            for seed in range(TRIED_REARRANGEMENTS):
                Rearrange().episode(open_scene(entry.source), seed=seed)
    except SceneError as fault:
        return str(fault)
    return ""


def set_text(scenes: SceneSet) -> str:
    """Return the TOML file of a set of homes as text."""
    rules = scenes.social_nav
    lines = [
        "format = 1",
        f'name = "{scenes.name}"',
        f'split = "{scenes.split}"',
        f'about = "{scenes.about}"',
        "scenes = [",
    ]
    for entry in scenes.scenes:
        home = entry.source
        assert isinstance(home, HomeSpec)
        lines.append(
            f'  {{ id = "{entry.id}", seed = {home.seed}, preset = "{home.preset}", area_m2 = {home.area_m2}, '
            f"bedrooms = {home.bedrooms}, bathrooms = {home.bathrooms}, clutter = {home.clutter}"
            f"{f', generation = {home.generation}' if home.generation > 1 else ''} }},"
        )
    lines += [
        "]",
        "",
        "[social_nav]",
        f"episodes_per_scene = {rules.episodes_per_scene}",
        f"spawn_distance_m = {rules.spawn_distance_m}",
    ]
    return "\n".join(lines) + "\n"


# --- the card ---------------------------------------------------------------------------------------------------------
def tables(splits: tuple[Split, ...]) -> dict[str, str]:
    """Return the measured tables of the card, per split and per home."""
    heads = ("scene", "floor m2", "free m2", "rooms", "receptacles", "small things", "triangles")
    keys = ("floor_m2", "free_m2", "rooms", "receptacles", "movable", "triangles")
    overview = [_line("split", "scenes", "episodes", "starts apart", *heads[1:]), _rule(10)]
    homes = [_line(*heads), _rule(7)]
    for split in splits:
        scenes = read_scene_set(builtin_root() / split.set_name / f"{split.name}.toml")
        rows = []
        for named in named_scenes(scenes.label):
            free = open_free_space(named.source, AGENT_RADIUS_M, AGENT_HEIGHT_M)
            rows.append(scene_size(named.name, open_scene(named.source), free))
            homes.append(_line(named.id, *(_number(rows[-1][k]) for k in keys)))
        apart = f"{scenes.social_nav.spawn_distance_m:g} m"
        ranges = (f"{_number(min(r[k] for r in rows))} to {_number(max(r[k] for r in rows))}" for k in keys)
        overview.append(_line(scenes.label, str(len(rows)), f"{scenes.episodes:,}", apart, *ranges))
    return {"splits": "\n".join(overview), "homes": "\n".join(homes)}


def _line(*cells: str) -> str:
    return f"| {' | '.join(cells)} |"


def _rule(columns: int) -> str:
    return "|---" + "|---:" * (columns - 1) + "|"


def _number(value: float) -> str:
    return f"{value:,.0f}"


def updated_card(text: str, parts: dict[str, str]) -> str:
    """Return the card with the texts between ``<!-- name -->`` and ``<!-- end -->`` replaced."""
    for name, table in parts.items():
        text, count = re.subn(
            f"(<!-- {name} -->\n).*?(<!-- end -->)", lambda m, t=table: f"{m[1]}{t}\n{m[2]}", text, flags=re.DOTALL
        )
        assert count == 1, name
    return text


def main() -> None:
    """Choose homes if requested, and write the tables of the card."""
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--choose", action="store_true", help="pick the homes anew")
    parser.add_argument("--set", default="h3-homes", choices=tuple(SETS), dest="set_name")
    parser.add_argument("--split", choices=[split.name for split in SPLITS], help="pick only the homes of one split")
    given = parser.parse_args()
    splits, folder = SETS[given.set_name], builtin_root() / given.set_name
    if given.choose:
        for split in splits:
            if given.split in (None, split.name):
                _write(folder / f"{split.name}.toml", set_text(chosen(split)))
    if given.split is None:
        card = folder / "README.md"
        _write(card, updated_card(card.read_text(encoding="utf-8"), tables(splits)))


def _write(path: Path, text: str) -> None:
    with part_file(path) as part:
        part.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
