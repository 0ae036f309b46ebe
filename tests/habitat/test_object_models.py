"""Objects of the YCB set and of Habitat's configs: meshes upright in metres, masses, grasps, and a home that holds them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from h3data.errors import InputError, SceneError
from h3data.scene import Scene, load_scene
from h3data_habitat.object_models import load_object_models, with_object_models
from h3data_homes import HomeSpec, build_home
from h3data_pipelines.cli import main


def obj(size: tuple[float, float, float], *, texture: str = "") -> str:
    """A box on the floor as a file of the YCB set has it: millimetres nowhere, +Z up, one texture."""
    x, y, z = size
    corners = [(a * x / 2, b * y / 2, c * z) for a in (-1, 1) for b in (-1, 1) for c in (0, 1)]
    quads = [(1, 2, 4, 3), (5, 7, 8, 6), (1, 5, 6, 2), (3, 4, 8, 7), (1, 3, 7, 5), (2, 6, 8, 4)]
    head = [f"mtllib {texture}", "usemtl m"] if texture else []
    lines = head + [f"v {a:.4f} {b:.4f} {c:.4f}" for a, b, c in corners] + ["vt 0 0"]
    return "\n".join(lines + ["f " + " ".join(f"{k}/1" for k in quad) for quad in quads]) + "\n"


def public_set(root: Path) -> Path:
    """Folders as the set is downloaded: several variants of a mesh, a kinbody beside them."""
    sizes = {"003_cracker_box": (0.06, 0.16, 0.21), "025_mug": (0.09, 0.08, 0.08), "013_apple": (0.07, 0.07, 0.07)}
    for name, size in sizes.items():
        for variant in ("google_16k", "tsdf"):
            folder = root / name / variant
            folder.mkdir(parents=True)
            small = tuple(s / (2 if variant == "tsdf" else 1) for s in size)
            (folder / "textured.obj").write_text(obj(small, texture="textured.mtl"))  # type: ignore[arg-type]
            (folder / "textured.mtl").write_text("newmtl m\nKd 0.8 0.1 0.1\n")
    (root / "003_cracker_box" / "google_16k" / "kinbody.xml").write_text(
        '<KinBody name="003_cracker_box"><Body type="dynamic"><Geom type="trimesh"><Data>textured.obj</Data></Geom>'
        '<Mass type="mimicgeom"><total>0.411</total></Mass></Body></KinBody>'
    )
    (root / "013_apple" / "google_16k" / "kinbody.xml").write_text(
        '<kinbody name="a"><body><mass type="box"><density>500</density></mass></body></kinbody>'
    )
    (root / "025_mug" / "google_16k" / "kinbody.xml").write_text('<KinBody name="m"><Body type="static"/></KinBody>')
    (root / "README.md").write_text("not an object")
    return root


def habitat_set(root: Path) -> Path:
    """``objects/ycb`` of Habitat: configs in one folder, meshes in another."""
    (root / "configs").mkdir(parents=True)
    for name, size, more in (
        ("024_bowl", (0.16, 0.16, 0.055), {"mass": 0.147}),
        ("004_sugar_box", (0.45, 0.9, 1.75), {"scale": [0.1, 0.1, 0.1], "semantic_id": 7}),
    ):
        meshes = root / "meshes" / name / "google_16k"
        meshes.mkdir(parents=True)
        (meshes / "textured.obj").write_text(obj(size))
        config = {
            "render_asset": f"../meshes/{name}/google_16k/textured.obj",
            "up": [0, 0, 1],
            "front": [0, 1, 0],
            **more,
        }
        (root / "configs" / f"{name}.object_config.json").write_text(json.dumps(config))
    return root


def test_folders_of_the_public_set(tmp_path: Path) -> None:
    models = load_object_models(public_set(tmp_path / "ycb"))
    assert list(models) == ["003_cracker_box", "013_apple", "025_mug"]
    box, apple, mug = models.values()
    np.testing.assert_allclose(box.bounds, [[-0.03, 0, -0.08], [0.03, 0.21, 0.08]], atol=1e-6)  # +Y is up, best variant
    assert (box.mass_kg, box.mass_from, box.grasp) == (0.411, "file", "body")
    np.testing.assert_allclose(box.grasp_point, [0, 0.105, 0], atol=1e-6)
    assert (apple.mass_kg, apple.mass_from) == (pytest.approx(500 * 0.07**3, abs=1e-4), "file")
    assert (mug.mass_kg, mug.mass_from, mug.grasp) == (0.35, "kind", "handle")  # its kinbody names none
    assert box.asset.category == "cracker_box"
    assert list(load_object_models(tmp_path / "ycb" / "025_mug")) == ["025_mug"]


def test_configs_of_habitat(tmp_path: Path) -> None:
    models = load_object_models(habitat_set(tmp_path / "objects" / "ycb"))
    bowl, sugar = models["024_bowl"], models["004_sugar_box"]
    assert (bowl.mass_kg, bowl.mass_from, bowl.grasp) == (0.147, "file", "rim")
    np.testing.assert_allclose(bowl.grasp_point, [0.08, 0.055, 0], atol=1e-6)
    np.testing.assert_allclose(sugar.bounds[1], [0.0225, 0.175, 0.045], atol=1e-6)
    assert (sugar.semantic_id, sugar.mass_from) == (7, "volume")
    assert sugar.mass_kg == pytest.approx(400 * 0.045 * 0.09 * 0.175, abs=1e-4)
    file = tmp_path / "objects" / "ycb" / "configs" / "024_bowl.object_config.json"
    assert list(load_object_models(file)) == ["024_bowl"]


def boxes(scene: Scene) -> dict[str, np.ndarray]:
    from h3data_habitat.object_models import _world_box

    return {i.name: _world_box(scene.assets[i.asset], i) for i in scene.instances if i.motion == "kinematic"}


def test_they_stand_where_the_things_of_a_home_stood(tmp_path: Path) -> None:
    models = load_object_models(public_set(tmp_path / "ycb"))
    home = build_home(HomeSpec(preset="small", seed=3))
    changed, count = with_object_models(home, models, seed=1)
    before, after = boxes(home), boxes(changed)
    assert count >= 10
    assert list(before) == list(after)
    new = [i for i in changed.instances if i.asset.startswith("object_")]
    assert len(new) == count
    for instance in new:
        a, b = before[instance.name], after[instance.name]
        np.testing.assert_allclose(b[0, 1], a[0, 1], atol=1e-5)  # on the same surface
        np.testing.assert_allclose((b[0] + b[1])[[0, 2]], (a[0] + a[1])[[0, 2]], atol=1e-5)
    assert {i.asset for i in changed.instances} <= set(changed.assets)
    used = changed.source["objects"]
    assert used["object_003_cracker_box"]["mass_kg"] == 0.411
    again, _ = with_object_models(home, models, seed=1)
    assert [i.asset for i in again.instances] == [i.asset for i in changed.instances]


@pytest.mark.slow
def test_a_home_with_them_is_rearranged(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    public_set(tmp_path / "ycb")
    command = [
        "scenes",
        "export",
        "small:3",
        "--to",
        "glb",
        "--objects",
        str(tmp_path / "ycb"),
        "-o",
        str(tmp_path / "o"),
    ]
    assert main([*command, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["objects"]["replaced"] >= 10
    assert told["objects"]["models"]["003_cracker_box"]["grasp"] == "body"
    scene = load_scene(Path(told["path"]).read_bytes())
    assert scene.source["objects"]["object_003_cracker_box"]["mass_kg"] == 0.411
    line = ["generate", "rearrange", "--scenes", told["path"], "--episodes", "1", "-o", str(tmp_path / "ds")]
    assert main(line) == 0
    assert main(["replay", str(tmp_path / "ds"), "--verify"]) == 0


@pytest.mark.parametrize(
    ("kinbody", "said"),
    [
        ('<!DOCTYPE k [<!ENTITY a "b">]><KinBody/>', "H3-HABITAT-102"),
        ("<KinBody>", "H3-HABITAT-105"),
        ("<KinBody><Mass><total>heavy</total></Mass></KinBody>", "H3-HABITAT-106"),
        ("<KinBody><Mass><total>-1</total></Mass></KinBody>", "H3-HABITAT-103"),
        ("<KinBody><Mass><total>nan</total></Mass></KinBody>", "H3-HABITAT-103"),
    ],
)
def test_damaged_kinbodies_are_refused_with_their_name(tmp_path: Path, kinbody: str, said: str) -> None:
    file = public_set(tmp_path / "ycb") / "003_cracker_box" / "google_16k" / "kinbody.xml"
    file.write_text(kinbody)
    with pytest.raises(SceneError, match=said) as fault:
        load_object_models(tmp_path / "ycb")
    assert str(file) in str(fault.value)


def test_what_holds_no_object_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="H3-HABITAT-099"):
        load_object_models(tmp_path / "ycb")
    with pytest.raises(InputError, match="H3-HABITAT-100"):
        load_object_models(tmp_path)
    file = habitat_set(tmp_path / "h") / "meshes" / "024_bowl" / "google_16k" / "textured.obj"
    file.unlink()
    with pytest.raises(SceneError, match=r"(?s)024_bowl.*textured\.obj.*H3-HABITAT-101"):
        load_object_models(tmp_path / "h")
