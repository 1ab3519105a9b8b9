"""C-V2X beside published curves and closed forms: `python -m benchmarks.cv2x`."""
