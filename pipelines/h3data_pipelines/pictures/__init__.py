"""Command ``h3data rerender`` (`rerender`), which writes videos and images from any camera, and its frame loop
(`rendering`).
"""
