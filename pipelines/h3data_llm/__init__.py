"""Agents whose tasks are chosen by a language model, as in ``--policy "llm:http://127.0.0.1:8000/v1?model=NAME"``.

The section "Language models" of h3data docs language describes these agents.
"""
