"""A robot that only tests know: a cart whose wheels are its first joints, with a mast and an arm of eight joints."""

from __future__ import annotations

from pathlib import Path

WHEELS = ("wheel_left", "wheel_right")
ARM = ("mast", *(f"arm_{k}" for k in range(8)))
"""The joints between base and hand: columns 2 to 10 of `cart_urdf`."""


def cart_urdf() -> str:
    """A URDF without meshes: base 0.5 x 0.4 x 0.3 m, a prismatic mast, eight revolute joints, a gripper of two fingers."""
    parts = [
        _link("base", "0.5 0.4 0.25", "0 0 0.175"),
        *(_link(name, cylinder=(0.08, 0.04)) for name in WHEELS),
        *(
            _joint(name, "continuous", "base", f"0 {y} 0.08", "0 0 1", rpy="-1.5707963 0 0")
            for name, y in zip(WHEELS, (0.2, -0.2), strict=True)
        ),
        _link("mast", "0.1 0.1 0.5", "0 0 0.05"),
        _joint("mast", "prismatic", "base", "0.1 0 0.5", "0 0 1", (0.0, 0.5)),
    ]
    # shoulder yaw, pitch and roll, elbow pitch, forearm roll, elbow pitch, wrist pitch, wrist roll
    axes = ("0 0 1", "0 1 0", "1 0 0", "0 1 0", "1 0 0", "0 1 0", "0 1 0", "1 0 0")
    offsets = (0.05, 0.05, 0.05, 0.25, 0.05, 0.15, 0.15, 0.08)
    parent = "mast"
    for k, (axis, offset) in enumerate(zip(axes, offsets, strict=True)):
        length = offsets[k + 1] if k + 1 < len(offsets) else 0.1
        z = 0.3 if k == 0 else 0.0
        parts.append(_link(f"arm_{k}", f"{length} 0.06 0.06", f"{length / 2} 0 0"))
        parts.append(_joint(f"arm_{k}", "revolute", parent, f"{offset} 0 {z}", axis, (-2.6, 2.6)))
        parent = f"arm_{k}"
    parts += [
        _link("gripper", "0.08 0.1 0.05", "0.04 0 0"),
        _joint("gripper_mount", "fixed", parent, "0.1 0 0", "0 0 0"),
        *(_link(f"finger_{side}", "0.06 0.01 0.03", "0.03 0 0") for side in ("left", "right")),
        _joint("finger_left", "prismatic", "gripper", "0.08 0.01 0", "0 1 0", (0.0, 0.04)),
        _joint("finger_right", "prismatic", "gripper", "0.08 -0.01 0", "0 -1 0", (0.0, 0.04), mimic="finger_left"),
    ]
    return "\n".join(['<robot name="cart">', *parts, "</robot>"])


def write_cart(folder: Path, settings: str = "") -> Path:
    """Writes ``cart.urdf`` into a folder, with a ``robot.toml`` if it has any settings; returns the URDF."""
    folder.mkdir(parents=True, exist_ok=True)
    urdf = folder / "cart.urdf"
    urdf.write_text(cart_urdf())
    if settings:
        (folder / "robot.toml").write_text(settings)
    return urdf


CART_SETTINGS = """
base_discs_m = [-0.1, 0.1]
base_radius_m = 0.26
body_height_m = 0.6
rest = [0, 0, 0.1, 0, -1.6, 0, 2.4, 0, 0.8, 0, 0, 0]
hand_link = "gripper"
hand_position = [0.1, 0, 0]
"""


def _link(name: str, box: str = "", at: str = "0 0 0", cylinder: tuple[float, float] = (0.0, 0.0)) -> str:
    radius, length = cylinder
    shape = f'<box size="{box}"/>' if box else f'<cylinder radius="{radius}" length="{length}"/>'
    geometry = f'<origin xyz="{at}"/><geometry>{shape}</geometry>'
    return f'<link name="{name}"><visual>{geometry}</visual><collision>{geometry}</collision></link>'


def _joint(
    child: str,
    kind: str,
    parent: str,
    at: str,
    axis: str,
    limits: tuple[float, float] | None = None,
    *,
    rpy: str = "0 0 0",
    mimic: str = "",
) -> str:
    link = child.removesuffix("_mount")
    limit = "" if limits is None else f'<limit lower="{limits[0]}" upper="{limits[1]}" effort="9" velocity="9"/>'
    follows = f'<mimic joint="{mimic}"/>' if mimic else ""
    return (
        f'<joint name="{child}" type="{kind}"><parent link="{parent}"/><child link="{link}"/>'
        f'<origin xyz="{at}" rpy="{rpy}"/><axis xyz="{axis}"/>{limit}{follows}</joint>'
    )
