#!/usr/bin/env python3
"""How long one core takes for one iteration of mutual information: ProDy beside our plain loop, in turn.

usage: mi_speed.py ONE_CORE ALIGNMENT.fasta...

ONE_CORE is the built example of that name (`cargo build --release -p mi-kernel --example one_core`); `farmctl alignment
thesis-a FILE` writes the thesis' sets. Prints CPU seconds of ProDy's `buildMutinfoMatrix(ambiguity=False, turbo=True)`, and of
the loop with its shuffle and without reading. Needs prody from PyPI.
"""
import re
import subprocess
import sys
import time

import prody


def prody_seconds(path):
    msa = prody.parseMSA(path)
    began = time.process_time()
    prody.buildMutinfoMatrix(msa, ambiguity=False, turbo=True)
    return time.process_time() - began


def plain_seconds(one_core, path):
    told = subprocess.run([one_core, path], check=True, capture_output=True, text=True).stdout
    return float(re.search(r": ([0-9.]+) s an iteration", told).group(1))


def main():
    if len(sys.argv) < 3:
        sys.exit(__doc__)
    prody.confProDy(verbosity="none")
    for path in sys.argv[2:]:
        theirs, ours = prody_seconds(path), plain_seconds(sys.argv[1], path)
        print(f"{path}: ProDy {theirs:.1f} s, plain loop {ours:.1f} s: {theirs / ours:.2f} times faster")


if __name__ == "__main__":
    main()
