"""Policies behind servers (openpi's websocket, GR00T's ZeroMQ), and a server for ours. Needs the extra ``remote``.

The table of docs/remote-policies.md says what an adapter file holds.
"""
