"""Independent tasks: the same results wherever they run, and a clean end by Ctrl-C."""

import os
import runpy
import signal
import subprocess
import sys
import threading
import time
from contextlib import suppress
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from dask_cluster import Cluster, first_last, refused
from extent import again as repeated
from loopback import CHECKOUT, SUPPORT, completed, patience, until
from sessions import study

from imu_calib.cli.main import main
from imu_calib.common.errors import NotObservable
from imu_calib.common.parallel import Engine, run_all
from imu_calib.simulation.repetition import repeat


@pytest.fixture
def scheduler(tmp_path_factory):
    """The address of a scheduler with one worker, which finds this file and the studies."""
    pytest.importorskip('distributed')
    cluster = Cluster(tmp_path_factory.mktemp('cluster'))
    folders = (Path(__file__).parent, SUPPORT, CHECKOUT / 'benchmarks', CHECKOUT / 'docs')
    with pytest.MonkeyPatch.context() as patched:
        patched.setenv('PYTHONPATH', os.pathsep.join(map(str, folders)))
        cluster.start()
    yield cluster.address
    cluster.stop()


def test_results_keep_the_order_of_the_tasks(tmp_path):
    ended: list[tuple[int, int]] = []
    found = run_all(partial(first_last, tmp_path), range(4), jobs=2, ended=ended.append)
    assert [task for task, _ in found] == [0, 1, 2, 3]
    assert ended == found
    assert os.getpid() not in {process for _, process in found}
    here = run_all(partial(first_last, tmp_path), [3, 1, 2], jobs=1)
    assert here == [(task, os.getpid()) for task in (3, 1, 2)]


@pytest.mark.parametrize('jobs', [1, 2])
def test_what_a_task_refuses_is_said(jobs):
    with pytest.raises(NotObservable, match='Nothing to see'):
        run_all(refused, range(3), jobs=jobs)


@pytest.mark.parametrize('after', [1, 4, 7, 10, 13, 16])
def test_a_run_that_is_interrupted_with_tasks_waiting_ends_quietly(after, monkeypatch):
    ended: list[int] = []
    errors: list[object] = []
    monkeypatch.setattr(threading, 'excepthook', errors.append)

    def take(result):
        ended.append(result)
        if len(ended) == after:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_all(abs, range(2000), jobs=2, ended=take)
    assert ended == list(range(after))
    assert errors == []


def loaded(name: str) -> bool:
    return name in sys.modules


def test_workers_begin_with_the_modules_of_their_tasks():
    pytest.importorskip('distributed')
    modules = ('scipy.special', 'wave')
    with Engine(workers=2, loads=modules[:1]).connected() as client:
        found = [client.run(loaded, name) for name in modules]
    assert [list(each.values()) for each in found] == [[True, True], [False, False]]


def test_a_cluster_gives_what_this_machine_gives(scheduler, tmp_path, capsys, monkeypatch):
    there = run_all(partial(first_last, tmp_path), [3, 1, 2], scheduler=scheduler)
    assert [task for task, _ in there] == [3, 1, 2]
    with pytest.raises(NotObservable, match='Nothing to see'):
        run_all(refused, range(3), scheduler=scheduler)
    here = repeat(study(), 2, seed=7, jobs=1)
    shown: list[tuple[int, int]] = []
    found = repeat(study(), 2, seed=7, scheduler=scheduler, show=lambda *at: shown.append(at))
    np.testing.assert_array_equal(here.errors, found.errors)
    assert shown == [(1, 2), (2, 2)]
    reach = ['plans', 'six_position', '--azimuth', '0', '--imu', 'fog_medium', '--height', '0']
    reach += ['--reach', 'D_gx=0.2deg/h']
    assert main(reach) == 0
    alone = capsys.readouterr().out
    assert main([*reach, '--scheduler', scheduler]) == 0
    assert capsys.readouterr().out == alone
    assert main(['plans', 'six_position', '--scheduler', scheduler]) == 2
    assert '--scheduler is for --reach' in capsys.readouterr().err
    # The tasks of a study are known by the name of a module, not by that of the script.
    script = CHECKOUT / 'benchmarks' / 'by_hand.py'
    words = [str(script), 'six_position_by_hand', '--runs', '2', '--scheduler', scheduler]
    monkeypatch.setattr(sys, 'argv', words)
    monkeypatch.syspath_prepend(script.parent)
    # Two runs say nothing of a spread: it may end with 1.
    with pytest.raises(SystemExit):
        runpy.run_path(str(script), run_name='__main__')
    assert 'six_position_by_hand: 2 runs' in capsys.readouterr().out


def test_what_callbacks_of_dask_raise_is_not_logged(scheduler, caplog):
    """One that cancels what was not begun does, where Ctrl-C comes early."""
    begun, over = threading.Event(), threading.Event()

    def fails():
        begun.set()
        raise NameError('There is no future yet.')

    with Engine(scheduler).connected() as client:
        for callback in (fails, over.set):
            client.loop.add_callback(callback)
        assert over.wait(patience())
    assert begun.is_set()
    assert 'no future' not in caplog.text


@pytest.mark.parametrize(
    ('where', 'again'),
    [('jobs', None), ('jobs', 0.01), repeated('jobs', 0.02), ('scheduler', 0.01)],
)
def test_ctrl_c_ends_a_study(where, again, request):
    command = [sys.executable, '-m', 'imu_calib.cli.main', 'montecarlo', 'twelve_position']
    option = ['--jobs', '2']
    if where == 'scheduler':
        option = ['--scheduler', request.getfixturevalue('scheduler')]
    running = subprocess.Popen(
        [*command, '--runs', '100000', *option],
        stderr=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        text=True,
        start_new_session=True,
    )
    group = os.getpgid(running.pid)
    try:
        # Both have processes or threads of their own when they are at work.
        assert until(lambda: at_work(running.pid, where), patience(120))
        # As a terminal sends it: to all of them.
        os.killpg(group, signal.SIGINT)
        while again is not None and running.poll() is None:
            # A key that is held down, while the workers and their threads end.
            time.sleep(again)
            os.killpg(group, signal.SIGINT)
        _, output = running.communicate(timeout=patience(120))
    finally:
        if running.poll() is None:
            os.killpg(group, signal.SIGKILL)
            running.communicate()
    assert running.returncode == 130
    assert output.strip().splitlines()[-1] == 'imu-calib montecarlo: interrupted'
    assert 'Traceback' not in output
    assert output.count('interrupted') == 1
    assert until(lambda: not in_group(group))


def at_work(process: int, where: str) -> bool:
    if where == 'jobs':
        # The resource tracker and two workers, which have loaded NumPy.
        children = Path(f'/proc/{process}/task/{process}/children').read_text().split()
        maps = [Path(f'/proc/{child}/maps').read_text() for child in children]
        return sum('_multiarray_umath' in text for text in maps) == 2
    return is_connected(process)


def is_connected(process: int) -> bool:
    """Return whether a process holds an established connection over TCP (proc(5): net/tcp)."""
    held = set()
    for descriptor in Path(f'/proc/{process}/fd').iterdir():
        with suppress(FileNotFoundError):
            held.add(str(descriptor.readlink()))
    rows = [line.split() for line in Path('/proc/net/tcp').read_text().splitlines()[1:]]
    return any(row[3] == '01' and f'socket:[{row[9]}]' in held for row in rows)


def in_group(group: int) -> list[str]:
    """Processes of a group."""
    found = []
    for stat in Path('/proc').glob('[0-9]*/stat'):
        try:
            state, _, of = stat.read_text().rpartition(')')[2].split()[:3]
        except (OSError, ValueError):
            continue
        if int(of) == group and state != 'Z':
            found.append(stat.parent.name)
    return found


def test_nothing_but_a_scheduler_asks_for_dask(monkeypatch, capsys):
    monkeypatch.setattr('imu_calib.common.files.find_spec', lambda name: None)
    assert run_all(refused, [0, 2], jobs=1) == [0, 2]
    command = ['montecarlo', 'twelve_position', '--runs', '1', '--scheduler', 'tcp://127.0.0.1:1']
    assert main(command) == 2
    assert "pip install '.[fleet]'" in capsys.readouterr().err


def test_what_is_no_address_ends_at_once():
    """In a process of its own: what Dask leaves behind speaks when the interpreter ends."""
    pytest.importorskip('distributed')
    addresses = ['nonsense', 'foo://host:8786', 'tcp://host:port']
    words = ['montecarlo', 'six_position', '--runs', '2', '--scheduler']
    code = f'from imu_calib.cli.main import main; print([main([*{words}, a]) for a in {addresses}])'
    done = completed([sys.executable, '-c', code], check=True)
    assert done.stdout.strip() == '[2, 2, 2]'
    for address, said in zip(addresses, done.stderr.strip().splitlines(), strict=True):
        assert f'found {address!r}, expected an address as tcp://host:8786' in said
