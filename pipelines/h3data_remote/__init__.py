"""Remote policies on servers of openpi (WebSocket) and GR00T (ZeroMQ), and a server for our policies.

The package needs the extra ``remote``. ``h3data docs remote-policies`` describes adapter files.
"""
