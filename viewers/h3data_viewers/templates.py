"""Templates of HTML pages (Jinja2), which lie next to the modules of this package, and pictures in pages.

All values are escaped.
"""

from __future__ import annotations

import base64
import hashlib
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from jinja2 import Environment
    from markupsafe import Markup


def render(template: str, **values: Any) -> str:
    """Return the text of a template, filled with values.

    Args:
        template: Path of the template relative to the folder of this package, such as ``notebook.html``.
        values: Values by their names in the template; a missing value is an error.
    """
    return environment().get_template(template).render(values)


def source(path: str) -> Markup:
    """Return a file of this package, such as a script or style sheet, for use in a page without escaping."""
    from markupsafe import Markup

    # not `include`, which would read the braces of scripts as those of templates
    loader = environment().loader
    assert loader is not None
    return Markup(loader.get_source(environment(), path)[0].strip())


@cache
def environment() -> Environment:
    """Return the environment of all templates, in which values are escaped and a missing value is an error."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    from h3data_viewers.html_report.tables import counted, cut, number

    pages = PackageLoader("h3data_viewers", "")
    found = Environment(loader=pages, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    found.globals |= {"counted": counted, "source": source}
    found.filters |= {"cut": cut, "number": number, "sha256": _sha256}
    return found


def _sha256(text: str) -> str:
    """Return the digest of an inline script or style by which a Content-Security-Policy allows it."""
    return base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()


def jpeg_data_uri(image: NDArray[np.uint8], *, quality: int = 80) -> str:
    """Return an image, RGB uint8 [H, W, 3], as a JPEG in a ``data:`` URI for HTML pages."""
    import cv2

    _, data = cv2.imencode(".jpg", np.ascontiguousarray(image[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, quality])
    return f"data:image/jpeg;base64,{base64.b64encode(data.tobytes()).decode()}"
