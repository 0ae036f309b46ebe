"""Texts for participants, by language.

Those of the package (``texts/*.json``) can be replaced by a study file (``[texts.de]``), which has to give all of them
for a further language (``[texts.fr]``).
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
    """A built-in questionnaire in a language."""

    title: str
    text: str
    low: str
    """Words at the lower end of the form's scales."""
    high: str
    items: dict[str, str]
    ends: dict[str, tuple[str, str]] = {}
    """Lower and higher end of the scales that have words of their own."""


class Language(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Texts in one language."""

    pages: dict[str, str]
    """Words of a study's pages, by name."""
    live: dict[str, str]
    """Words of the page of episodes, by name."""
    forms: dict[str, FormWords] = {}
    """Built-in questionnaires; the English ones are in `h3data_studies.forms`."""
    said: dict[str, str] = {}
    """Translations of the server's sentences, by the English sentence; ``{}`` is replaced by a value."""
    things: dict[str, str] = {}
    """Words for things and places, by the English words."""


@cache
def shipped(language: str) -> Language | None:
    """Return the texts of the package in a language, such as ``de`` or ``de-AT``; None: there are none."""
    short = language.partition("-")[0]
    if short not in SHIPPED:
        return None
    return msgspec.json.decode((FOLDER / f"{short}.json").read_bytes(), type=Language)


ENGLISH: dict[str, str] = shipped("en").pages  # type: ignore[union-attr]
LIVE: dict[str, str] = shipped("en").live  # type: ignore[union-attr]


def words(design: Design, language: str) -> dict[str, str]:
    """Return all words of a study's pages in a language: those of the package where the study file has no others."""
    found = shipped(language)
    return ENGLISH | (found.pages if found is not None else {}) | design.texts.get(language, {})


def page_words(design: Design, language: str) -> dict[str, str]:
    """Return all texts of the page in a language.

    They are `words`, those of episodes as ``live_NAME``, and translations of the server's English sentences and words
    for things as ``said.TEXT`` and ``things.TEXT``.
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
    """Return the names of the words that a study in this language lacks; empty: all are there."""
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
