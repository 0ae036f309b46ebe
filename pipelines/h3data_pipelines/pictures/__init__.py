"""Command ``h3data rerender``, which writes videos and images from any camera (`rerender`); `rendering` is its frame loop."""
