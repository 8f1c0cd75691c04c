"""Write docs/messages.md: every field of the messages and the action of imu_calib_msgs.

Usage: python docs/messages.py
"""

import re
from pathlib import Path

PAGE = Path(__file__).with_suffix('.md')
FOLDER = Path(__file__).resolve().parents[1] / 'msg_defs'
LINE = re.compile(r'(?P<kind>[\w/\[\]]+) +(?P<name>\w+)(?P<value>=\S+)? *(?:# *(?P<words>.*))?')

HEAD = """# Messages

The messages of the package `imu_calib_msgs` ([msg_defs/msg](../msg_defs/msg)) and its action
([msg_defs/action](../msg_defs/action)), from which this page is written
(`python docs/messages.py`). On which topics they go, and with which quality of service:
[middleware.md](middleware.md#quality-of-service). The others are those of ROS: `sensor_msgs/Imu`,
`sensor_msgs/JointState`, `sensor_msgs/Temperature`, `diagnostic_msgs/DiagnosticArray`.
"""


def page() -> str:
    """Return the page."""
    messages = sorted(FOLDER.glob('msg/*.msg'))
    actions = sorted(FOLDER.glob('action/*.action'))
    return HEAD + ''.join(_section(path) for path in [*messages, *actions])


def _section(path: Path) -> str:
    """Return the table of a message; a line of comment alone goes on with what is above it."""
    parts = iter(['**result**', '**feedback**'])
    lead: list[str] = []
    rows: list[list[str]] = []
    for line in path.read_text('utf-8').splitlines():
        if line == '---':
            rows.append(['', '', next(parts)])
        found = LINE.fullmatch(line.strip())
        if found:
            name = found['name'] + (found['value'] or '')
            rows.append([found['kind'], name, found['words'] or ''])
        elif line.strip().startswith('#'):
            words = line.strip().lstrip('# ')
            if not rows:
                lead.append(line.strip()[1:].removeprefix(' '))
            elif line.startswith(' '):
                rows[-1][2] += f' {words}'
            else:
                rows.append(['', '', words])
    text = (
        f'\n## {path.stem}\n\n```text\n' + '\n'.join(lead) + '\n```\n\n| type | field | meaning |\n'
    )
    text += '|---|---|---|\n'
    for kind, name, words in rows:
        prose = words if words.startswith('**') else re.sub(r'([|*<])', r'\\\1', words)
        text += f'| {_code(kind)} | {_code(name)} | {prose} |\n'
    return text


def _code(text: str) -> str:
    return f'`{text}`' if text else ''


if __name__ == '__main__':
    PAGE.write_text(page(), encoding='utf-8')
