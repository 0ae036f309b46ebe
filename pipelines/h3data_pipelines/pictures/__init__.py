"""Command ``h3data rerender`` (`rerender`), which writes videos and images, and its frame loop (`rendering`)."""
