"""Names of learned skills and the weights that they refer to: files, folders of files, and those in the package."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path

from h3data.builtin import builtin_path
from h3data.errors import FormatError, InputError
from sim_kinematic.policies.learned import PREFIX, network_of, stamped
from sim_kinematic.policies.network import RUN_POLICY
from sim_kinematic.policies.skills.player import TASKS, NetworkSkill
from sim_kinematic.policies.visual_policy import VisualPolicy

LEARNED = "learned"
"""Name of the three learned skills that are included in the package."""
SHIPPED = tuple(f"policies/{task}.npz" for task in TASKS)


def recorded_skills(skills: str) -> str:
    """Return the names of learned skills as recordings store them.

    The names are files of weights with the digests of their contents, separated by commas. For the included skills the
    name is ``learned@`` and one digest of all three.

    Args:
        skills: `LEARNED`, the folder of a training run, a folder of such folders or of policy files, policy files separated
            by commas, or an earlier result of this function. Empty means none.

    Raises:
        InputError: A file does not exist, has no skill, or differs from the digest in its name; or two files are for the
            same skill.
    """
    if not skills:
        return ""
    if skills.partition("@")[0] == LEARNED:
        skills_of(skills)  # raises if the digest in the name is that of another version
        return f"{LEARNED}@{_shipped_digest()}"
    names = []
    for word in skills.split(","):
        path = Path(word.removeprefix(PREFIX))
        names += (
            [PREFIX + str(file) for file in _files_in(path)] if path.is_dir() else [PREFIX + word.removeprefix(PREFIX)]
        )
    found = ",".join(stamped(name) for name in names)
    skills_of(found)
    return found


def _files_in(folder: Path) -> list[Path]:
    """Return the policy file of a training run, those of the runs in a folder, or the policy files in it."""
    runs = [file for file in (folder / RUN_POLICY, *sorted(folder.glob(f"*/{RUN_POLICY}"))) if file.is_file()]
    # sorted, because recordings name the files in this order
    files = runs or sorted(folder.glob("*.npz"))
    if not files:
        raise InputError(f"Expected policy files of skills, found none. Folder: {folder}", code="H3-POLICY-053")
    return files


def _shipped_digest() -> str:
    """Return the first 12 digits of one digest of the three included skills."""
    from hashlib import sha256

    digests = [network_of(PREFIX + str(builtin_path(file))).digest for file in SHIPPED]
    return sha256("".join(digests).encode()).hexdigest()[:12]


def skills_of(skills: str, *, robot: str = "") -> Mapping[str, NetworkSkill]:
    """Return the learned skills that some names stand for, by the name of the upper layer's skill.

    Raises:
        InputError: A file does not exist, has no skill, or two files are for the same skill.
        FormatError: A file is for another robot.
    """
    if not skills:
        return {}
    word, _, digest = skills.partition("@")
    if word == LEARNED:
        if digest and digest != (own := _shipped_digest()):
            raise InputError(
                f"The skills of this version are not those that {skills} names: their digest is {own}.",
                code="H3-POLICY-054",
            )
        return _found(tuple(PREFIX + str(builtin_path(file)) for file in SHIPPED), robot)
    return _found(tuple(skills.split(",")), robot)


@lru_cache(maxsize=8)
def _found(names: tuple[str, ...], robot: str) -> Mapping[str, NetworkSkill]:
    """Return the skills of files by the skills of the upper layer, loaded once."""
    found: dict[str, NetworkSkill] = {}
    for name in names:
        network = network_of(name)
        if not isinstance(network, VisualPolicy):
            raise FormatError(
                f"Expected weights of a skill, these are for {network.task!r}. File: {name.removeprefix(PREFIX)}",
                code="H3-POLICY-055",
            )
        try:
            skill = NetworkSkill(network, robot=robot)
        except FormatError as fault:
            raise FormatError(f"{fault} File: {name.removeprefix(PREFIX)}", code=fault.code) from None
        if twice := [one for one in skill.skills if one in found]:
            raise InputError(
                f"Two of the files are for {twice[0]}. File: {name.removeprefix(PREFIX)}", code="H3-POLICY-056"
            )
        found |= dict.fromkeys(skill.skills, skill)
    return found
