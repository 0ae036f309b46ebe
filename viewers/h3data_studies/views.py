"""Views of the study's page: plain data that the page shows at each stage."""

from __future__ import annotations

import hashlib
from typing import Any

from h3data_studies.design import Design, Form
from h3data_studies.flow import COMPLETE, SCREENED_OUT, SMALL
from h3data_studies.store import Participant
from h3data_studies.texts import page_words, words


def text_hash(text: str) -> str:
    """Return the SHA-256 digest of a text that a participant has read."""
    return hashlib.sha256(text.encode()).hexdigest()


def _page(design: Design, language: str, stage: dict[str, Any], **more: Any) -> dict[str, Any]:
    return {
        "title": design.say(design.title, language),
        "contact": design.contact,
        "language": language,
        "languages": list(design.languages),
        "participant": None,
        "progress": {"done": 0, "of": 0},
        "words": page_words(design, language),
        "stage": stage,
    } | more


def consent_view(design: Design, language: str) -> dict[str, Any]:
    """Return the view with the consent text."""
    text, said = design.say(design.consent.text, language), words(design, language)
    facts = [
        said["retention"].format(date=design.retention.isoformat()),
        said["contact"].format(contact=design.contact),
    ]
    if design.minutes is not None:
        facts.insert(0, said["minutes"].format(minutes=design.minutes))
    stage = {
        "kind": "consent",
        "about": design.say(design.about, language),
        "text": text,
        "facts": facts,
        "version": design.consent.version,
        "hash": text_hash(text),
    }
    return _page(design, language, stage)


def end_view(
    design: Design, language: str, status: str, reason: str = "", *, own_code: str = "", **more: Any
) -> dict[str, Any]:
    """Return the view of the last page, with the participant's personal completion code if the study has such codes."""
    said, recruiting = words(design, language), design.recruiting
    code, url = "", ""
    if status == COMPLETE:
        code, url = (own_code if recruiting.unique_codes else recruiting.completion_code), recruiting.completion_url
    elif status == SCREENED_OUT:
        code, url = recruiting.screen_out_code, recruiting.screen_out_url
    because = said.get("tutorial_failed" if reason == "tutorial" else reason, reason)
    stage = {
        "kind": "end",
        "status": status,
        "reason": reason,
        "heading": said[f"{status}_title"],
        "text": said[status].format(reason=because),
        "code": code,
        "url": url.replace("{code}", code),
    }
    return _page(design, language, stage, **more)


def stage_view(design: Design, participant: Participant, *, own_code: str = "") -> dict[str, Any]:
    """Return the view of a participant's next stage; ``own_code`` is the personal completion code for `end_view`."""
    progress, language = participant.progress, participant.language
    stage, said = progress.stage, words(design, language)
    more = {"participant": participant.id, "progress": {"done": progress.done, "of": len(progress.stages)}}
    if stage.kind == "end":
        return end_view(design, language, progress.status, progress.reason, own_code=own_code, **more)
    told: dict[str, Any] = {"kind": stage.kind}
    if stage.kind == "device":
        told["again"] = said["small_window_again"] if SMALL in progress.rows else ""
    elif stage.kind == "tutorial":
        attempt, of = progress.attempts + 1, design.tutorial.attempts
        text = design.say(design.tutorial.text, language) or said["tutorial"]
        if attempt > 1:
            text = f"{said['tutorial_again'].format(attempt=attempt, of=of)}\n{text}"
        told |= {"attempt": attempt, "of": of, "text": text}
    elif stage.kind == "episode":
        block = progress.place.blocks[stage.block - 1]
        # the name of the condition stays here: participants are blind to it
        told |= {
            "block": stage.block,
            "blocks": len(progress.place.blocks),
            "trial": stage.trial,
            "trials": len(block.episodes),
            "text": (design.say(design.condition(block.condition).text, language) or said["episode"])
            if stage.trial == 1
            else said["episode_next"],
        }
    elif stage.kind == "form":
        told |= {"block": stage.block, "trial": stage.trial, **_form(design, progress.form, language)}
        told["again"] = ""
        if progress.tries:
            attempt, of = progress.tries + 1, progress.form.attempts
            default = said["check_again"].format(attempt=attempt, of=of)
            told["again"] = design.say(progress.form.again, language) or default
    return _page(design, language, told, **more)


def _form(design: Design, form: Form, language: str) -> dict[str, Any]:
    items = [
        {
            "id": item.id,
            "kind": item.kind,
            "text": design.say(item.text, language),
            "low": design.say(item.low, language),
            "high": design.say(item.high, language),
            "min": item.min,
            "max": item.max,
            "step": item.step,
            "options": [design.say(option, language) for option in item.options],
            "required": item.required,
        }
        for item in form.items
    ]
    title, text = design.say(form.title, language), design.say(form.text, language)
    return {"form": form.id, "heading": title, "text": text, "items": items}
