"""Mutation testing by a random sample: the share of small changes that a package's tests detect.

The changes are cosmic-ray's (operators, numbers, conditions, decorators, loops); annotations are
excluded, because they are not evaluated. Each mutant runs in a fork of a process that has loaded
NumPy and SciPy, in a copy of the tree, up to the first test that fails.

    pip install cosmic-ray
    python benchmarks/mutants.py [--packages recordings] [--draw 40] [--seed 1] [--minutes 5]

A package that runs out of time keeps the mutants tested so far: their order is random.
"""

from __future__ import annotations

import argparse
import ast
import compileall
import contextlib
import importlib
import multiprocessing
import os
import random
import resource
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from py_compile import PycInvalidationMode

import pytest
from cosmic_ray.ast import ast_nodes, get_ast
from cosmic_ray.mutating import mutate_code
from cosmic_ray.plugins import get_operator, operator_names

ROOT = Path(__file__).resolve().parent.parent
# The tests of a package, the fastest first; sessions on a stand are excluded.
TESTS = {
    'recordings': [
        'cdr',
        'merged_topics',
        'record_walk',
        'mcap_records',
        'chunk_summary',
        'mcap_scan',
        'mcap_storage',
        'row_queries',
        'codec',
        'journal',
        'mcap_writer',
        'bags',
        'damaged_bags',
    ],
    'calibration': [
        'by_temperature',
        'live_queues',
        'sample_clock',
        'compensation',
        'compensator',
        'in_motion',
    ],
    'segmentation': [
        'counter_sums',
        'straight_lines',
        'stamp_lines',
        'clock_lines',
        'cleaning',
        'gaps',
        'statistics',
        'moves_joined',
        'one_turn',
        'between_streams',
        'joint_tracker',
        'names_by_order',
        'labelling',
        'segment_values',
        'rest_tolerance',
        'intake',
        'dwell_read',
        'one_stand',
        'sample_grid',
        'segmentation',
    ],
    'live': ['steps', 'encoders', 'watch', 'sequencer'],
    'estimation': [
        'term_sentences',
        'whitened_residuals',
        'drift_odds',
        'search_steps',
        'excess_scatter',
        'arrowhead',
        'converge',
        'fit_steps',
        'rows',
        'headings',
        'courses',
        'latitude_seen',
        'common_rests',
        'common_table',
        'output_noise',
        'remainders',
        'evidence_values',
        'led_moves',
        'session_slopes',
        'ideal_ways',
        'information',
        'conclude',
        'closed_forms',
        'checks',
        'gains',
        'rate_equations',
        'skewed_points',
        'joint_words',
    ],
}
# Tests of certain modules, too slow for every mutant of a package; they run first.
MORE = {
    'imu_calib/recordings/remote.py': ['remote_copy', 'remote'],
    'imu_calib/estimation/hand.py': ['free_fit'],
    'imu_calib/estimation/outputs.py': ['arms'],
    'imu_calib/estimation/free_dwells.py': ['free_fit'],
}
# Allowed time of a mutant relative to the unchanged tests, and additional seconds.
SLOWER, MORE_S = 2.0, 5.0


def annotations(source: str) -> list[tuple[tuple[int, int], tuple[int, int]]]:
    """Return where annotations start and end, each by line and column."""
    nodes = list(ast.walk(ast.parse(source)))
    parts = [getattr(node, name, None) for node in nodes for name in ('annotation', 'returns')]
    found = [part for part in parts if part is not None]
    return [((p.lineno, p.col_offset), (p.end_lineno, p.end_col_offset)) for p in found]


def mutants(package: str) -> list[tuple[str, str, int, int]]:
    """Return path, operator, occurrence and line of all mutants of a package."""
    found = []
    for path in sorted((ROOT / 'imu_calib' / package).rglob('*.py')):
        source = path.read_text()
        left_out, nodes = annotations(source), list(ast_nodes(get_ast(source)))
        for name in operator_names():
            if get_operator(name).arguments():
                continue
            operator = get_operator(name)()
            places = [place for node in nodes for place in operator.mutation_positions(node)]
            found += [(str(path.relative_to(ROOT)), name, occurrence, start[0])
                      for occurrence, (start, _) in enumerate(places)
                      if not any(a <= start < b for a, b in left_out)]  # fmt: skip
    return found


def file_of(copy: Path, name: str) -> Path:
    """Return the file of tests with a name, whichever room it is in."""
    (file,) = copy.glob(f'test/*/test_{name}.py')
    return file


def run_tests(copy: Path, tests: Sequence[str], limit_s: float) -> tuple[bool, float]:
    """Return whether the tests pass in a fork, and its processor time in s."""
    child = os.fork()
    if not child:
        os.setsid()
        quiet = os.open(os.devnull, os.O_WRONLY)
        os.dup2(quiet, 1), os.dup2(quiet, 2)
        resource.setrlimit(resource.RLIMIT_CPU, (int(limit_s) + 1, int(limit_s) + 1))
        os.chdir(copy)
        sys.path[:0] = [str(copy), str(copy / 'test' / 'support')]
        # Processes started by a test also use the copy.
        others = os.environ.get('PYTHONPATH', '').split(os.pathsep)
        os.environ['PYTHONPATH'] = os.pathsep.join(filter(None, [str(copy), *others]))
        files = [str(file_of(copy, name)) for name in tests]
        # A waiting test uses no processor time: the session's own limit ends it.
        options = ['-x', '-q', '-p', 'no:cacheprovider', '-o', f'timeout={10 * int(limit_s)}']
        # Failure texts would be created from every test file again for each mutant.
        options.append('--assert=plain')
        os._exit(int(pytest.main([*options, *files])))
    _, status, used = os.wait4(child, 0)
    with contextlib.suppress(ProcessLookupError):
        os.killpg(child, signal.SIGKILL)  # what a mutant has started and left behind
    return status == 0, used.ru_utime + used.ru_stime


def naming_first(copy: Path, path: str, tests: Sequence[str]) -> list[str]:
    """Return the tests in their order, but those that name a module first."""
    module = path.removesuffix('.py').replace('/', '.')
    return sorted(tests, key=lambda name: module not in file_of(copy, name).read_text())


def work(share: list, tests: list[str], ends: float, answers: multiprocessing.Queue) -> None:
    """Test a share of the mutants; None ends the answers in every case."""
    try:
        test(share, tests, ends, answers)
    finally:
        answers.put(None)


def test(share: list, tests: list[str], ends: float, answers: multiprocessing.Queue) -> None:
    """Test mutants in a copy of the tree, one after the other."""
    # As in test/conftest.py, which comes too late here: threads that wait for each other spin.
    os.environ['OMP_NUM_THREADS'] = '1'
    for module in ('linalg', 'optimize', 'signal', 'spatial.transform', 'special', 'stats'):
        importlib.import_module(f'scipy.{module}')
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / 'tree'
        left_out = shutil.ignore_patterns('.git', '.venv', '__pycache__')
        shutil.copytree(ROOT, copy, ignore=left_out)
        # By content: otherwise compiled files are distinguished only by the second.
        by_hash = PycInvalidationMode.CHECKED_HASH
        compileall.compile_dir(copy, quiet=2, invalidation_mode=by_hash)
        unchanged = {}  # how long each set of tests takes, s
        for path, name, occurrence, line in share:
            files = naming_first(copy, path, [*MORE.get(path, []), *tests])
            alike = frozenset(files)
            if alike not in unchanged:
                sound, unchanged[alike] = run_tests(copy, files, 600.0)
                if not sound:
                    print('The tests fail before anything is changed.', flush=True)
                    break
            if time.monotonic() > ends:
                break
            source = (copy / path).read_text()
            try:
                changed = mutate_code(source, get_operator(name)(), occurrence)
            except AttributeError:
                continue  # the name of an exception that has a dot in it
            (copy / path).write_text(changed)
            lives, _ = run_tests(copy, files, SLOWER * unchanged[alike] + MORE_S)
            (copy / path).write_text(source)
            text = changed.splitlines()[line - 1].strip()
            answers.put((lives, f'{path}:{line} {name.split("/")[1]}: {text}'))


def interval(killed: int, drawn: int) -> tuple[float, float]:
    """Return the 95 % interval of a share, by Wilson (1927)."""
    z, share = 1.96, killed / drawn
    middle = (share + z * z / (2 * drawn)) / (1 + z * z / drawn)
    half = z / (1 + z * z / drawn) * (share * (1 - share) / drawn + (z / (2 * drawn)) ** 2) ** 0.5
    return middle - half, middle + half


def score(package: str, draw: int, seed: int, minutes: float, workers: int) -> None:
    """Print the survivors of a package and its row of the table."""
    population = mutants(package)
    drawn = random.Random(seed).sample(population, min(draw, len(population)))
    answers: multiprocessing.Queue = multiprocessing.Queue()
    ends = time.monotonic() + 60.0 * minutes
    for n in range(workers):
        given = drawn[n::workers], TESTS[package], ends, answers
        multiprocessing.Process(target=work, args=given).start()
    tested, killed, working = 0, 0, workers
    while working:
        match answers.get():
            case None:
                working -= 1
            case lives, text:
                tested, killed = tested + 1, killed + (not lives)
                print('survived' if lives else 'killed', text, flush=True)
    low, high = (100 * share for share in interval(killed, max(tested, 1)))
    row = package, ', '.join(TESTS[package]), len(population), tested, killed, tested - killed
    share = f'{100 * killed / max(tested, 1):.0f} %', f'{low:.0f} to {high:.0f} %'
    print('|', *[f'{cell} |' for cell in (*row, *share)], flush=True)


if __name__ == '__main__':
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--packages', nargs='+', default=list(TESTS), choices=list(TESTS))
    parser.add_argument('--draw', type=int, default=100)
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument('--minutes', type=float, default=60.0, help='the most for one package')
    parser.add_argument('--workers', type=int, default=2, help='processes that test')
    given = parser.parse_args()
    for each in given.packages:
        score(each, given.draw, given.seed, given.minutes, given.workers)
