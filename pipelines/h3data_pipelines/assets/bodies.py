"""Command ``h3data bodies``, which lists, renders and bakes the bodies of people."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro

from h3data.bodies import Humanoid, humanoid_names, load_humanoid
from h3data.commands.command import ForceFlag, Group, JsonFlag, Outcome, claim_file
from h3data.errors import InputError

HEADINGS_DEG = {"front": -90.0, "back": 90.0, "side": 0.0}


@dataclass(frozen=True)
class BodiesShow:
    """Render people standing, walking or reaching. Without -o, the bodies are only listed.

    Examples:
        h3data bodies show
        h3data bodies show -o bodies.png
        h3data bodies show female_1 me.npz -o two.png --view side
        h3data bodies show male_0 --outfits -o outfits.png
        h3data bodies show --outfit dress female_0 child_0 -o dresses.png --view walk
        h3data bodies show -o faces.jpg --view face
        h3data bodies show male_0 -o walk.png --view walk --speed 1.3
        h3data bodies show female_2 male_1 -o reach.png --view reach
    """

    names: tyro.conf.Positional[tuple[str, ...]] = ()
    """Built-in bodies or .npz files (default: all built-in bodies)."""
    out: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """PNG or JPEG file to write."""
    view: Literal["front", "back", "side", "face", "walk", "reach"] = "front"
    """Direction of view, or one of: face (heads only); walk (one gait cycle from the right); reach (reaching poses,
    and the first body picking up and placing a mug).
    """
    outfit: str | None = None
    """Clothes that all bodies wear instead of their own: casual, smart, knit, sport, pyjamas, dress or summer."""
    outfits: bool = False
    """Show every body in every outfit, with one row for each body."""
    speed: float = 1.3
    """Walking speed for --view walk [m/s]."""
    low_detail: bool = False
    """Render the low-detail meshes."""
    width: int = 1600
    """Width of the image [pixels]."""
    force: ForceFlag = False
    json: JsonFlag = False

    def run(self) -> Outcome:
        """Render the bodies, and return their names and sizes."""
        from h3data.render.image_files import write_image

        names = self._names()
        people = [load_humanoid(name) for name in names]
        rows = [_row(body) for body in people]
        lines = [
            f"{r['name']:<12} {r['height_m']:.2f} m  {r['vertices']:>6} vertices, low detail {r['lod_vertices']}"
            for r in rows
        ]
        if self.out is None:
            return Outcome(text="\n".join(lines), data={"bodies": rows})
        if not 200 <= self.width <= 8000:
            raise InputError(f"--width must be from 200 to 8000, got {self.width}.", code="H3-BODY-123")
        if not 0 < self.speed <= 4:
            raise InputError(f"--speed must be above 0 and at most 4 m/s, got {self.speed}.", code="H3-BODY-124")
        if self.out.suffix.lower() not in (".png", ".jpg", ".jpeg"):
            raise InputError(f"Expected a file name that ends in .png or .jpg, got: {self.out}", code="H3-BODY-125")
        target = claim_file(self.out, force=self.force)
        image = self._render(people)
        write_image(target, image)
        height, width = image.shape[:2]
        data = {"file": str(target), "width": width, "height": height, "bodies": rows}
        return Outcome(text=f"wrote {target} ({width}x{height}, {len(people)} bodies)", data=data)

    def _names(self) -> list[str]:
        from h3data.bodies.people.look.wardrobe import OUTFITS, SEPARATOR, split_outfit

        names = list(self.names or humanoid_names())
        if self.outfits:
            return [f"{split_outfit(name)[0]}{SEPARATOR}{outfit}" for name in names for outfit in OUTFITS]
        return [f"{split_outfit(name)[0]}{SEPARATOR}{self.outfit}" for name in names] if self.outfit else names

    def _render(self, people: list[Humanoid]) -> Any:
        from h3data.bodies.people.look.wardrobe import OUTFITS
        from h3data_pipelines.assets.people_pictures import face_picture, sheet_picture, walk_picture

        if self.view == "walk":
            strips = [walk_picture(body, self.speed, lod=self.low_detail, width=self.width) for body in people]
            return np.concatenate(strips)
        if self.view == "face":
            return face_picture(people, lod=self.low_detail, width=self.width)
        if self.view == "reach":
            from h3data_pipelines.assets.reaching import reach_picture

            return reach_picture(people, lod=self.low_detail, width=self.width)
        columns = len(OUTFITS) if self.outfits else 6
        heading = HEADINGS_DEG[self.view]
        return sheet_picture(people, heading_deg=heading, lod=self.low_detail, columns=columns, width=self.width)


@dataclass(frozen=True)
class BodiesBake:
    """Bake a body from phenotype parameters (needs pip install 'h3data[bodies]') or from your own SMPL-X model file.

    The resulting file can be given wherever a body's name is expected: --human me.npz. Baking runs in a checkout of the
    repository only.

    Examples:
        h3data bodies bake -o me.npz --gender 0.3 --stature 1.82 --weight 0.6 --age 0.8
        h3data bodies bake -o short.npz --gender 1 --stature 1.58 --skin 150,100,74 --hairstyle bun --outfit dress
        h3data bodies bake -o child.npz --age 0.3 --stature 1.2 --hairstyle tousled
        h3data bodies bake -o smplx.npz --smplx SMPLX_NEUTRAL.npz --betas 0.5 --betas -1.2
    """

    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """.npz file to write; its stem becomes the body's name."""
    gender: float = 0.5
    """Gender from 0 (male) to 1 (female)."""
    age: float = 0.67
    """Age from 0.3 (child) and 0.67 (young adult) to 1 (old)."""
    stature: float = 1.70
    """Standing height [m]."""
    weight: float = 0.45
    """Weight from 0 (thin) to 1 (heavy)."""
    muscle: float = 0.5
    """Muscularity from 0 to 1."""
    african: float = 0.0
    """Share of African features; the share that --african and --asian leave is Caucasian."""
    asian: float = 0.0
    """Share of Asian features."""
    skin: str = "200,150,118"
    """Skin colour as R,G,B from 0 to 255 (sRGB)."""
    hair: str = "60,44,34"
    """Hair colour as R,G,B from 0 to 255 (sRGB)."""
    hairstyle: Literal[
        "crop", "short", "swept", "tousled", "bob", "long", "tail", "bun", "curls", "waves", "receding", "scarf"
    ] = "short"
    """Cut of the hair, or a headscarf over it."""
    beard: bool = False
    """Give the person a short full beard."""
    outfit: Literal["casual", "smart", "knit", "sport", "pyjamas", "dress", "summer"] = "casual"
    """Clothes; the baked body can be used with any other outfit later, as me.npz:dress."""
    palette: int = 0
    """Number of the outfit's colour palette."""
    smplx: Path | None = None
    """Your own licensed SMPL-X model file (SMPLX_NEUTRAL.npz); of the options above, only --skin applies to it."""
    betas: tuple[float, ...] = ()
    """Shape coefficients for --smplx."""
    force: ForceFlag = False
    json: JsonFlag = False

    def run(self) -> Outcome:
        """Write the body's .npz file.

        Raises:
            InputError: a parameter is out of range.
        """
        if self.out.suffix != ".npz":
            raise InputError(f"Expected a file name that ends in .npz, got: {self.out}", code="H3-BODY-126")
        limits = {
            "gender": (0, 1),
            "age": (0.25, 1),
            "stature": (1.0, 2.1),
            "weight": (0, 1),
            "muscle": (0, 1),
            "african": (0, 1),
            "asian": (0, 1 - self.african),
        }
        for name, (low, high) in limits.items():
            if not low <= getattr(self, name) <= high:
                raise InputError(
                    f"--{name} must be from {low} to {high}, got {getattr(self, name)}.", code="H3-BODY-127"
                )
        colors = {name: _color(name, getattr(self, name)) for name in ("skin", "hair")}
        target = claim_file(self.out, force=self.force)
        try:
            self._bake(target, colors)
        except ModuleNotFoundError as error:
            if (error.name or "").startswith("bake"):
                hint = "Run the command in a checkout of the repository: the package has the baked bodies only."
            else:
                hint = "pip install 'h3data[bodies]'"
            raise InputError(
                f"Baking needs the module {error.name}, which is not installed. Hint: {hint}", code="H3-BODY-128"
            ) from None
        load_humanoid.cache_clear()
        body = load_humanoid(target)
        return Outcome(text=f"wrote {target}: {body}", data={"file": str(target), **_row(body)})

    def _bake(self, target: Path, colors: dict[str, tuple[int, int, int]]) -> None:
        if self.smplx is not None:
            from bake.people.smplx import bake_smplx

            bake_smplx(self.smplx, target, betas=self.betas, color=colors["skin"])
            return
        from bake.people.designs import BodySpec, look, phenotype
        from bake.people.humanoid import bake_bodies

        parameters = phenotype(
            self.gender, age=self.age, muscle=self.muscle, weight=self.weight, african=self.african, asian=self.asian
        )
        looks = look(
            colors["skin"],
            colors["hair"],
            self.hairstyle,
            self.outfit,
            self.palette,
            beard=self.beard,
            lines=max(0.0, min(1.0, 2.2 * (self.age - 0.74))),
        )
        spec = BodySpec(phenotype=parameters, stature_m=self.stature, look=looks)
        bake_bodies({target.stem: spec}, target.parent)


BODIES = Group(
    "Bodies of people: list and show the built-in ones, bake new ones.",
    {"show": BodiesShow, "bake": BodiesBake},
)


def _row(body: Humanoid) -> dict[str, Any]:
    return {
        "name": body.name,
        "height_m": body.height_m,
        "vertices": len(body.mesh.vertices),
        "lod_vertices": len(body.lod_mesh.vertices),
        "phenotype": dict(body.phenotype),
    }


def _color(name: str, text: str) -> tuple[int, int, int]:
    parts = text.split(",")
    if len(parts) != 3 or not all(p.strip().isdecimal() and int(p) <= 255 for p in parts):
        raise InputError(
            f"--{name} must be an sRGB colour such as 200,150,118 (0 to 255 each), got {text!r}.", code="H3-BODY-122"
        )
    return int(parts[0]), int(parts[1]), int(parts[2])
