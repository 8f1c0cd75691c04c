"""Files are written whole; what is no file is not replaced by one."""

import os
import stat
import threading

import pytest

from imu_calib.errors import InputError
from imu_calib.paths import write_whole


def names(folder):
    return [path.name for path in folder.iterdir()]


def test_a_file_is_replaced_and_nothing_is_left_beside_it(tmp_path):
    path = tmp_path / 'result.yaml'
    path.write_text('a longer text than the next one')
    write_whole(path, 'new')
    assert path.read_text() == 'new'
    assert names(tmp_path) == ['result.yaml']


def test_a_link_stays_and_its_file_is_written(tmp_path):
    folder = tmp_path / 'elsewhere'
    folder.mkdir()
    link = tmp_path / 'latest.yaml'
    link.symlink_to(folder / 'today.yaml')
    write_whole(link, 'new')
    assert link.is_symlink()
    assert (folder / 'today.yaml').read_text() == 'new'
    assert names(folder) == ['today.yaml']


def test_a_pipe_takes_the_text_and_stays_a_pipe(tmp_path):
    """As /dev/null and /dev/stdout do: a user who may write /dev must not lose them."""
    pipe = tmp_path / 'pipe'
    os.mkfifo(pipe)
    messages = []
    reader = threading.Thread(target=lambda: messages.append(pipe.read_text()))
    reader.start()
    write_whole(pipe, 'new')
    reader.join()
    assert messages == ['new']
    assert stat.S_ISFIFO(pipe.stat().st_mode)
    assert names(tmp_path) == ['pipe']


def test_what_cannot_be_written_is_said_and_leaves_nothing(tmp_path):
    with pytest.raises(InputError, match=r'results: cannot be written \(Is a directory\)'):
        (tmp_path / 'results').mkdir()
        write_whole(tmp_path / 'results', 'new')
    assert names(tmp_path) == ['results']
    with pytest.raises(InputError, match='No such file or directory'):
        write_whole(tmp_path / 'no' / 'result.yaml', 'new')
