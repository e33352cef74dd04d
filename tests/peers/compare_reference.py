#!/usr/bin/env python3
"""Compares a rendered EXR with a converged reference image.

usage: compare_reference.py IMAGE.exr REFERENCE.npy

REFERENCE.npy is linear RGB, (height, width, 3) float32. Prints the mean ratio (image over reference, over all channels and for
each), and relMSE = mean((image - reference)^2 / (reference^2 + 0.01)), also without the worst 0.1 % of the pixels.
Needs numpy and OpenEXR from PyPI.
"""
import sys

import numpy as np
import OpenEXR


def read_rgb(path):
    """The beauty image: (height, width, 3) float32."""
    with OpenEXR.File(path) as image:
        for part in image.parts:
            channels = part.channels
            for name in ("RGB", "RGBA"):
                if name in channels:
                    return np.asarray(channels[name].pixels, np.float32)[..., :3]
            if all(c in channels for c in "RGB"):
                return np.stack([np.asarray(channels[c].pixels, np.float32) for c in "RGB"], -1)
    sys.exit(f"{path}: no R, G, B channels")


def main():
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    image, reference = read_rgb(sys.argv[1]).astype(np.float64), np.load(sys.argv[2]).astype(np.float64)
    if image.shape != reference.shape:
        sys.exit(f"sizes differ: {sys.argv[1]} {image.shape}, {sys.argv[2]} {reference.shape}")
    relative = ((image - reference) ** 2 / (reference**2 + 0.01)).mean(-1)
    trimmed = np.sort(relative.ravel())[: int(relative.size * 0.999)]
    channels = " ".join(f"{image[..., c].mean() / reference[..., c].mean():.5f}" for c in range(3))
    print(
        f"mean ratio {image.mean() / reference.mean():.5f} (channels {channels})  "
        f"relMSE {relative.mean():.6f}  without the worst 0.1 % {trimmed.mean():.6f}  "
        f"non-finite {int((~np.isfinite(image)).sum())}"
    )


if __name__ == "__main__":
    main()
