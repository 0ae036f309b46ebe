"""Words of the study's pages. A study file replaces them, or has them in other languages (``[texts.de]``)."""

from __future__ import annotations

from h3data_viewers.hitl.study.design import Design

ENGLISH: dict[str, str] = {
    "agree": "I agree and take part",
    "decline": "I do not take part",
    "declined_title": "Thank you",
    "declined": "Nothing has been stored. You can close this page.",
    "contact": "Questions: {contact}",
    "retention": "Recordings and answers are deleted by {date}.",
    "minutes": "Takes about {minutes} minutes.",
    "language": "Language",
    "begin": "Begin",
    "next": "Next",
    "send": "Send",
    "progress": "Step {done} of {of}",
    "device_title": "Checking your computer",
    "device": "This takes a few seconds.",
    "tutorial_title": "Practice",
    "tutorial": "First, a practice round in which nothing counts: walk about, take a thing, and bring it to its place.",
    "tutorial_again": "That was not quite it. Please try once more (try {attempt} of {of}).",
    "block_title": "Part {block} of {blocks}",
    "episode_title": "Round {trial} of {trials}",
    "episode": "Bring the things to their places. Press Begin when you are ready.",
    "episode_next": "Press Begin when you are ready for the next round.",
    "pause": "Pause",
    "paused_title": "Paused",
    "paused": "The home stands still. Go on when you are ready.",
    "go_on": "Go on",
    "withdraw": "Stop taking part",
    "withdraw_title": "Stop taking part?",
    "withdraw_text": "You can stop at any time, without giving a reason. You cannot come back to this session.",
    "stay": "Go on with the study",
    "required": "Please answer every question.",
    "complete_title": "Thank you!",
    "complete": "You have finished the study.",
    "code": "Your completion code",
    "return": "Return to the recruiting site",
    "id": "Your participant number, should you want your data deleted: {id}",
    "screened_out_title": "Thank you for trying",
    "screened_out": "You cannot take part: {reason}",
    "no_webgl": "this browser cannot show 3D pictures (WebGL).",
    "slow_connection": "the connection to the server is too slow.",
    "small_window": "the window is too small.",
    "small_window_again": "The window is too small for this study: turn the device to landscape, or enlarge the window, and "
    "try again.",
    "try_again": "Try again",
    "cannot_enlarge": "It cannot be larger",
    "slow_graphics": "this computer draws 3D pictures too slowly.",
    "touch": "this study needs a keyboard.",
    "tutorial_failed": "the practice was not completed.",
    "dropped_title": "The session has ended",
    "dropped": "There was no activity for too long, so your place has been given to somebody else.",
    "withdrawn_title": "You have left the study",
    "withdrawn": "Thank you for your time. Tell us your participant number if you want your data deleted.",
    "full_title": "All places are taken",
    "full": "Thank you for your interest. There is no place left in this study at the moment.",
    "need_id_title": "This link is not complete",
    "need_id": "Please open the study by the link of the recruiting site.",
    "placeholder_title": "This link is not complete",
    "placeholder": "The recruiting site has not filled in {reason}: the link still has a placeholder in its place. Please open "
    "the study by the link of the recruiting site, or ask the contact below.",
    "bad_id_title": "This link is not right",
    "bad_id": "The {reason} in this link does not have the form of an id of the recruiting site. Please open the study by the "
    "link of the recruiting site, or ask the contact below.",
    "elsewhere_title": "This id takes part already",
    "elsewhere": "Somebody takes part, or has taken part, with this id in another browser. Please go on in that browser. If "
    "you cannot, ask the contact below for a link with which you can go on here.",
    "occupied_title": "Somebody else takes part in this browser",
    "occupied": "The session of another participant goes on in this browser. Please use another browser, or a private window.",
}


def words(design: Design, language: str) -> dict[str, str]:
    """All words in a language: the built-in English ones where the study file has no others."""
    return ENGLISH | design.texts.get(language, {})
