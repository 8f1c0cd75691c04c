#!/usr/bin/env bash
# Commonly expected: a correlation can be stated between any two uncertain numbers, as between two
# with infinite degrees of freedom.
#
# What happens: two that were made one by one with finite degrees of freedom are refused, declared
# dependent or not, by an error about an "ensemble". They have to be made together by
# multiple_ureal; then it is accepted, and the sum keeps the degrees of freedom.
#
# Seen with GTC 1.5.1, Python 3.11, on 27 November 2026.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check GTC==1.5.1
"$folder/venv/bin/python" - <<'PROGRAM'
import sys

from GTC import multiple_ureal, set_correlation, ureal


def attempt(first, second):
    try:
        set_correlation(0.5, first, second)
    except RuntimeError as error:
        return f'refused: {str(error)[:50]}...'
    total = first + second
    return f'accepted: u = {total.u:.4f}, degrees of freedom {total.df:g}'


def one(dof):
    return ureal(1.0, 0.1, dof, independent=False)


seen = [
    ('infinite, one by one', attempt(one(float('inf')), one(float('inf')))),
    ('10, one by one', attempt(one(10), one(10))),
    ('10, together', attempt(*multiple_ureal([1.0, 1.0], [0.1, 0.1], 10))),
]
for case, what in seen:
    print(f'{case}: {what}')
sys.exit([what.split(':')[0] for _, what in seen] != ['accepted', 'refused', 'accepted'])
PROGRAM
