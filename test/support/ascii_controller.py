"""Controllers of a table on a socket, which speak the protocol of docs/tables.md."""

import contextlib
import socket
import threading
import time

import numpy as np

from imu_calib.simulation.motion import Track, trapezoid


class Controller:
    """Speaks the protocol of docs/tables.md; axes go at 1000 deg/s, whatever they are told."""

    def __init__(self):
        self.server = socket.create_server(('127.0.0.1', 0))
        self.url = f'socket://127.0.0.1:{self.server.getsockname()[1]}'
        self.lines = []
        self.angles, self.goals = [0.0] * 3, [0.0] * 3
        self.script = {}
        self.silent = False
        self.connections = 0
        self.line = None
        threading.Thread(target=self.serve, daemon=True).start()

    def serve(self):
        while True:
            try:
                self.line, _ = self.server.accept()
            except OSError:
                return
            self.connections += 1
            with contextlib.suppress(OSError), self.line, self.line.makefile('r') as lines:
                for text in lines:
                    if not text.strip():
                        continue
                    self.lines.append(text.strip())
                    if not self.silent:
                        self.line.sendall(f'{self.reply(text.split())}\r\n'.encode())

    def reply(self, words):
        if words[0] in self.script:
            return self.script[words[0]]
        if words[0] == 'MOVE':
            self.goals[int(words[1]) - 1] = float(words[2])
        elif words[0] == 'STOP':
            self.goals = list(self.angles)
        elif words[0] == 'STATE':
            moving = [np.clip(g - a, -20, 20) for a, g in zip(self.angles, self.goals, strict=True)]
            self.angles = [a + m for a, m in zip(self.angles, moving, strict=True)]
            numbers = [*self.angles, *(50 * m for m in moving)]
            return ' '.join(['STATE', *(f'{n:.5f}' for n in numbers)])
        return 'OK'

    def count(self, word):
        return sum(line.split()[0] == word for line in self.lines)

    def close(self):
        # Closing alone does not wake who waits in accept.
        with contextlib.suppress(OSError):
            self.server.shutdown(socket.SHUT_RDWR)
        self.server.close()
        if self.line is not None:
            self.line.close()


class Servo(Controller):
    """A controller whose axes go on trapezoids, at 9000 deg/s^2, as they are told."""

    def __init__(self):
        self.began = time.monotonic()
        self.tracks = [Track.standing(0.0, np.zeros(1)) for _ in range(3)]
        super().__init__()

    def reply(self, words):
        now = time.monotonic() - self.began
        at = [track.at(np.array([now])) for track in self.tracks]
        places = [float(place[0, 0]) for place, _ in at]
        if words[0] == 'STATE':
            numbers = [*places, *(float(rate[0, 0]) for _, rate in at)]
            return ' '.join(['STATE', *(f'{number:.6f}' for number in numbers)])
        if words[0] == 'MOVE':
            k, goal, rate = int(words[1]) - 1, float(words[2]), float(words[3])
            if abs(goal - places[k]) > 1e-6:
                self.tracks[k] = trapezoid(now, places[k], goal, rate, 9000.0)
        if words[0] == 'STOP':
            self.tracks = [Track.standing(now, np.array([place])) for place in places]
        return 'OK'
