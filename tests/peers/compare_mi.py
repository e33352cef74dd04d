#!/usr/bin/env python3
"""Compares what `farmctl mi` wrote with ProDy and scikit-learn.

usage: compare_mi.py ALIGNMENT.fasta MI_BITS.npy NULL_MEAN_BITS.npy ITERATIONS [PAIRS]

Prints the largest difference of the mutual information from ProDy's `buildMutinfoMatrix(ambiguity=False, turbo=True)` in nats
off the diagonal, how long ProDy took for it (one iteration, one core), and for PAIRS pairs (200 by default, drawn with a fixed
seed) by how many standard errors the null mean is off the closed form of scikit-learn (`expected_mutual_information`).
Needs numpy, prody and scikit-learn from PyPI.
"""
import sys
import time

import numpy as np
import prody
from sklearn.metrics.cluster import contingency_matrix, expected_mutual_information


def main():
    if len(sys.argv) not in (5, 6):
        sys.exit(__doc__)
    path, iterations = sys.argv[1], int(sys.argv[4])
    ours, null = (np.load(name) * np.log(2) for name in sys.argv[2:4])
    prody.confProDy(verbosity="none")
    msa = prody.parseMSA(path)
    began = time.process_time()
    theirs = prody.buildMutinfoMatrix(msa, ambiguity=False, turbo=True)
    seconds = time.process_time() - began
    off_diagonal = ~np.eye(len(ours), dtype=bool)
    worst = np.abs(ours - theirs)[off_diagonal].max()
    print(f"{path}: {msa.numSequences()} x {msa.numResidues()}: |MI - ProDy| <= {worst:.2e} nats, ProDy {seconds:.1f} s of CPU")

    # Every byte that is no letter is a gap there and here.
    letters = np.char.upper(msa.getArray().astype(str))
    letters[~np.char.isalpha(letters)] = "-"
    draw = np.random.default_rng(1)
    pairs = int(sys.argv[5]) if len(sys.argv) == 6 else 200
    columns = np.array([draw.choice(letters.shape[1], 2, replace=False) for _ in range(pairs)])
    errors = []
    for i, j in columns:
        table = contingency_matrix(letters[:, i], letters[:, j], sparse=True)
        expected = expected_mutual_information(table, len(letters))
        # Of a null of some hundred degrees of freedom the deviation is about that of a chi square over 2 N.
        rows, cols = table.shape
        deviation = np.sqrt(2.0 * max(rows - 1, 1) * max(cols - 1, 1)) / (2.0 * len(letters))
        if rows > 1 and cols > 1:
            errors.append((null[i, j] - expected) / (deviation / np.sqrt(iterations)))
    errors = np.abs(errors)
    print(f"null mean of {len(errors)} pairs: off the closed form by {errors.mean():.2f} standard errors on average, {errors.max():.2f} at most")


if __name__ == "__main__":
    main()
