"""Policies behind servers (openpi's websocket, GR00T's ZeroMQ), and a server for our policies. Needs the extra ``remote``.

h3data docs remote-policies says what an adapter file holds.
"""
