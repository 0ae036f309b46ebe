"""Texts for participants, by language.

A study file can replace the texts of the package (``texts/*.json``) with ``[texts.de]``. For another language
(``[texts.fr]``) it has to give all texts.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path

import msgspec

import h3data_play
from h3data_studies.design import Design, Form, Text

FOLDER = Path(h3data_play.__file__).parent / "texts"
SHIPPED = ("en", "de", "es")


class FormWords(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Words of a built-in questionnaire in one language."""

    title: str
    text: str
    low: str
    """Words at the lower end of the form's scales."""
    high: str
    items: dict[str, str]
    ends: dict[str, tuple[str, str]] = {}
    """Lower and upper end of the scales that have their own words, by item."""


class Language(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Texts in one language."""

    pages: dict[str, str]
    """Texts of a study's pages, by name."""
    live: dict[str, str]
    """Texts of the page on which episodes are played, by name."""
    forms: dict[str, FormWords] = {}
    """Built-in questionnaires; the English ones are in `h3data_studies.forms`."""
    said: dict[str, str] = {}
    """Translations of the server's sentences, by the English sentence; ``{}`` stands for a value."""
    things: dict[str, str] = {}
    """Translations of names of objects and places, by the English words."""


@cache
def shipped(language: str) -> Language | None:
    """Return the texts of the package in a language, such as ``de`` or ``de-AT``; None if there are none."""
    short = language.partition("-")[0]
    if short not in SHIPPED:
        return None
    return msgspec.json.decode((FOLDER / f"{short}.json").read_bytes(), type=Language)


ENGLISH: dict[str, str] = shipped("en").pages  # type: ignore[union-attr]
LIVE: dict[str, str] = shipped("en").live  # type: ignore[union-attr]


def words(design: Design, language: str) -> dict[str, str]:
    """Return all texts of a study's pages in a language: those of the study file, else those of the package."""
    found = shipped(language)
    return ENGLISH | (found.pages if found is not None else {}) | design.texts.get(language, {})


def page_words(design: Design, language: str) -> dict[str, str]:
    """Return all texts of the page in a language.

    They are the texts of `words`, the texts of episodes as ``live_NAME``, and translations of the server's English
    sentences as ``said.TEXT`` and of names of objects as ``things.TEXT``.
    """
    found = shipped(language)
    if found is None:
        return words(design, language)
    return {
        **{f"live_{name}": text for name, text in found.live.items()},
        **{f"said.{name}": text for name, text in found.said.items()},
        **{f"things.{name}": text for name, text in found.things.items()},
        **words(design, language),
    }


def missing(design: Design, language: str) -> list[str]:
    """Return the names of the texts that a study lacks in this language; empty if it is complete."""
    if shipped(language) is not None:
        return []
    given = design.texts.get(language, {})
    return [name for name in (*ENGLISH, *(f"live_{name}" for name in LIVE)) if name not in given]


def in_all_languages(name: str, form: Form) -> Form:
    """Translate a built-in questionnaire, given in English, into the languages of the package."""
    found = {code: language.forms[name] for code in SHIPPED if (language := shipped(code)) and name in language.forms}

    def text(english: Text, in_language: Callable[[FormWords], str]) -> Text:
        assert isinstance(english, str)
        return {"en": english} | {code: in_language(words) for code, words in found.items()}

    items = []
    for item in form.items:
        key = item.id
        low, high = (
            text(english, lambda words, key=key, end=end: words.ends.get(key, (words.low, words.high))[end])
            for end, english in enumerate((item.low, item.high))
        )
        said = text(item.text, lambda words, key=key: words.items[key])
        items.append(msgspec.structs.replace(item, text=said, low=low, high=high))
    title, about = text(form.title, lambda words: words.title), text(form.text, lambda words: words.text)
    return msgspec.structs.replace(form, title=title, text=about, items=items)
