"""``h3data rerender`` writes videos and images from any camera (`rerender`); `rendering` is its frame loop."""
