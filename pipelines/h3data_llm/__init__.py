"""Agents whose work a language model chooses: ``--policy "llm:http://127.0.0.1:8000/v1?model=NAME"``.

h3data docs language describes them (Language models).
"""
