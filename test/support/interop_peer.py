"""One end of an exchange, run by either runtime.

`talk` sends every message, `hear` prints them, `stream` sends a session's streams in a burst.
`record`, with rclpy, prints what test/data/messages_of_ros.json holds: bytes and hashes of ROS.
"""

import json
import sys
import time
from pathlib import Path

from imu_calib.live import middleware as ros

M = ros.messages
KINDS = {
    'bool': M.Bool, 'calibration': M.ImuCalibration, 'data_raw': M.Imu,
    'diagnostics': M.DiagnosticArray, 'header': M.Header, 'joints': M.JointState,
    'progress': M.CalibrationProgress, 'quaternion': M.Quaternion, 'setpoint': M.TurntableSetpoint,
    'state': M.TurntableState, 'temperature': M.Temperature, 'text': M.String,
    'time': M.Clock, 'trajectory': M.JointTrajectory, 'vector': M.Vector3,
}  # fmt: skip
INNER = {
    'status': M.DiagnosticStatus, 'values': M.KeyValue, 'points': M.JointTrajectoryPoint,
    'calibrations': M.ImuCalibration,
}  # fmt: skip
QOS = ros.QoSProfile(depth=1, durability=ros.DurabilityPolicy.TRANSIENT_LOCAL)


def filled(kind, seed=1):
    """Return a message whose fields differ from each other and from zero."""
    message = kind()
    fields = kind.get_fields_and_field_types()
    fields.pop('structure_needs_at_least_one_member', None)  # of an empty one; ROS hides it
    for number, (name, spelled) in enumerate(fields.items(), seed):
        setattr(message, name, value(getattr(message, name), name, spelled, number))
    return message


def value(now, name, spelled, number):
    if hasattr(now, 'get_fields_and_field_types'):
        return filled(type(now), number + 1)
    if name == 'goals_canceling':
        return [filled(type(ros.actions.RunCalibration.Impl.CancelGoalService.Request().goal_info))]
    if name in INNER and isinstance(now, list):
        return [filled(INNER[name], number + k) for k in range(2)]
    if 'string' in spelled:
        text = f'{name} \u00e4 {number}'
        return [text, '', text[:3]] if 'sequence' in spelled else text
    if spelled == 'boolean':
        return True
    if spelled == 'octet':
        return bytes([number % 4])
    if 'sequence' in spelled and 'int' in spelled:
        return [number, 0, number + 1]
    if '[' in spelled and 'int' in spelled:
        return [number + k for k in range(len(now))]
    if '[' in spelled:
        return [number + k / 8 for k in range(len(now))]
    if 'sequence' in spelled:
        return [number - k / 8 for k in range(5)]
    return number / 8 if isinstance(now, float) else number


def plain(message):
    """Return a message as lists, texts and numbers."""
    if hasattr(message, 'get_fields_and_field_types'):
        return {n: plain(getattr(message, n)) for n in message.get_fields_and_field_types()}
    if isinstance(message, bytes):
        return list(message)
    if isinstance(message, (str, bool, int, float)):
        return message
    return [plain(v) for v in message]


def talk(node):
    """Keep every message latched, count, and serve, until the process is ended."""
    for topic, kind in KINDS.items():
        node.create_publisher(kind, topic, QOS).publish(filled(kind))
    counter = node.create_publisher(M.String, 'count', 10)
    node.create_timer(0.05, lambda: counter.publish(M.String(data='tick')))

    def answer(request, response):
        response.success, response.message = True, 'heard'
        return response

    node.create_service(ros.Trigger, '~/start', answer)
    print('ready', flush=True)
    sys.stdin.close()
    ros.spin(node)


def listen(node):
    """Print what comes on every topic, and the answer of the service where it is asked."""
    got = {}
    for topic, kind in KINDS.items():
        node.create_subscription(kind, topic, lambda m, t=topic: got.update({t: plain(m)}), QOS)
    end = time.monotonic() + float(sys.argv[2])
    while len(got) < len(KINDS) and time.monotonic() < end:
        ros.spin_once(node, timeout_sec=0.1)
    if 'ask' in sys.argv:
        client = node.create_client(ros.Trigger, '/stand/talker/start')
        if client.wait_for_service(timeout_sec=float(sys.argv[2])):
            future = client.call_async(ros.Trigger.Request())
            ros.spin_until_future_complete(node, future, timeout_sec=float(sys.argv[2]))
            got['answer'] = plain(future.result()) if future.done() else None
    expected = {topic: plain(filled(kind)) for topic, kind in KINDS.items()}
    nodes = node.get_node_names_and_namespaces()
    print(json.dumps({'got': got, 'expected': expected, 'nodes': nodes}))


def stream(node):
    """Latch a state, then send every stream of a session as fast as it goes, once it is heard."""
    count = int(sys.argv[2])
    keep_all = ros.QoSProfile(history=ros.HistoryPolicy.KEEP_ALL)
    state = node.create_publisher(M.TurntableState, 'turntable/state', QOS)
    state.publish(filled(M.TurntableState))
    kinds = {'imu/pulses': M.Imu, 'imu/skew': M.Imu, 'turntable/joint_states': M.JointState}
    publishers, payloads = [], []
    for topic, kind in kinds.items():
        publishers.append(node.create_publisher(kind, topic, keep_all))
        message = filled(kind)
        for message.header.stamp.sec in range(count):
            payloads.append((publishers[-1], ros.serialize_message(message)))
    payloads.sort(key=lambda p: p[1][4:8][::-1])
    print('ready', flush=True)
    while any(p.get_subscription_count() == 0 for p in [state, *publishers]):
        ros.spin_once(node, timeout_sec=0.1)
    for publisher, payload in payloads:
        publisher.publish(payload)
    print(all(ros.acknowledged(p, float(sys.argv[3])) for p in [state, *publishers]), flush=True)
    sys.stdin.read()


SERVICES = ('SendGoal', 'GetResult', 'CancelGoal')


def of_action(name):
    """Return the names of all messages that ROS makes of an action."""
    own = ['Goal', 'Result', 'Feedback', 'FeedbackMessage']
    services = [f'{s}_{side}' for s in SERVICES[:2] for side in ('Request', 'Response')]
    return [f'{name}_{part}' for part in own + services]


def record():
    """Print the hash of every type, and the bytes of its filled message, as ROS has them."""
    from ament_index_python import get_package_share_directory

    action = ros.actions.RunCalibration
    services = [ros.Trigger, *(getattr(action.Impl, f'{s}Service') for s in SERVICES)]
    answers = [kind for s in services for kind in (s.Request, s.Response)]
    parts = [action.Goal, action.Result, action.Feedback, action.Impl.FeedbackMessage]
    known = {}
    others = [M.TimeMsg, M.DurationMsg, *answers, *parts]
    for kind in [*KINDS.values(), *INNER.values(), *others]:
        package, folder = kind.__module__.split('.')[:2]
        name = f'{package}/{folder}/{kind.__name__}'
        known[name] = {'bytes': ros.serialize_message(filled(kind)).hex()}
    for name in ('Gid', 'NodeEntitiesInfo', 'ParticipantEntitiesInfo'):
        known[f'rmw_dds_common/msg/{name}'] = {}
    # Goals of the controller have fields of one name and different kinds: their hashes are told.
    known |= {name: {} for name in of_action('control_msgs/action/FollowJointTrajectory')}
    known['action_msgs/msg/GoalStatusArray'] = {}
    for name, described in known.items():
        package, folder, short = name.split('/')
        share = Path(get_package_share_directory(package)) / folder
        file = share / f'{short.partition("_")[0]}.json'
        hashes = json.loads(file.read_text())['type_hashes']
        described['hash'] = {h['type_name']: h['hash_string'] for h in hashes}[name]
    print(json.dumps(known, indent=1, sort_keys=True))


if __name__ == '__main__':
    if sys.argv[1] == 'record':
        record()
        raise SystemExit
    role = {'talk': talk, 'hear': listen, 'stream': stream}[sys.argv[1]]
    # The streams have the names that config/record_qos.yaml knows.
    namespace = '/' if role is stream else '/stand'
    ros.init(args=['--ros-args', '-r', f'__ns:={namespace}'])
    role(ros.Node(f'{sys.argv[1]}er'.replace('hearer', 'listener')))
    ros.shutdown()
