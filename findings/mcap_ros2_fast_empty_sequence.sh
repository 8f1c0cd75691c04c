#!/usr/bin/env bash
# Commonly expected: a decoder of ROS 2 messages reads a Detection3D of vision_msgs with or without
# hypotheses; a sequence without elements is four bytes of count.
#
# What happens: behind a sequence of messages the decoder takes the alignment of its last element,
# though without elements there is only that of the count, four. A box at 1, 2, 3 m is read as at 0,
# 5e-315, 5e-315, without a word, if the frame is "lidar_top"; if it is "camera" the padding fits by
# chance. The encoder of the same library leaves out four bytes, so its messages are misread by others.
#
# Seen with mcap-ros2-support-fast 0.8.0 beside mcap-ros2-support 0.6.0, Python 3.11, on 28 November
# 2026.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check \
  mcap-ros2-support-fast==0.8.0 ros-parser==0.9.0 mcap-ros2-support==0.6.0 mcap==1.6.0
"$folder/venv/bin/python" - <<'PROGRAM'
import io
import sys
from types import SimpleNamespace as Message

import mcap_ros2.decoder
import mcap_ros2_support_fast
from mcap.reader import make_reader
from mcap_ros2.writer import Writer

NAME = 'vision_msgs/msg/Detection3D'
TYPES = {
    'std_msgs/Header': 'builtin_interfaces/Time stamp\nstring frame_id',
    'builtin_interfaces/Time': 'int32 sec\nuint32 nanosec',
    'vision_msgs/ObjectHypothesisWithPose': 'vision_msgs/ObjectHypothesis hypothesis\n'
    'geometry_msgs/PoseWithCovariance pose',
    'vision_msgs/ObjectHypothesis': 'string class_id\nfloat64 score',
    'geometry_msgs/PoseWithCovariance': 'geometry_msgs/Pose pose\nfloat64[36] covariance',
    'geometry_msgs/Pose': 'geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation',
    'geometry_msgs/Point': 'float64 x\nfloat64 y\nfloat64 z',
    'geometry_msgs/Quaternion': 'float64 x\nfloat64 y\nfloat64 z\nfloat64 w',
    'vision_msgs/BoundingBox3D': 'geometry_msgs/Pose center\ngeometry_msgs/Vector3 size',
    'geometry_msgs/Vector3': 'float64 x\nfloat64 y\nfloat64 z',
}
DEFINITION = (
    'std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\n'
    'vision_msgs/BoundingBox3D bbox\nstring id\n'
) + ''.join(f'{"=" * 80}\nMSG: {name}\n{fields}\n' for name, fields in TYPES.items())


def detection(frame):
    position = Message(x=1.0, y=2.0, z=3.0)
    orientation = Message(x=0.0, y=0.0, z=0.0, w=1.0)
    return Message(
        header=Message(stamp=Message(sec=1, nanosec=2), frame_id=frame),
        results=[],
        bbox=Message(
            center=Message(position=position, orientation=orientation),
            size=Message(x=4.0, y=5.0, z=6.0),
        ),
        id='tree',
    )


def read(recording, module):
    recording.seek(0)
    reader = make_reader(recording, decoder_factories=[module.DecoderFactory()])
    for _, _, raw, message in reader.iter_decoded_messages():
        position = message.bbox.center.position
        return bytes(raw.data), (position.x, position.y, position.z)


schema = Message(id=1, name=NAME, encoding='ros2msg', data=DEFINITION.encode())
encode = mcap_ros2_support_fast.ROS2EncoderFactory().encoder_for(schema)
results = {}
for frame in ('camera', 'lidar_top'):
    recording = io.BytesIO()
    writer = Writer(recording)
    topic = writer.register_msgdef(NAME, DEFINITION)
    writer.write_message('/box', topic, detection(frame), log_time=1, publish_time=1)
    writer.finish()
    raw, usual = read(recording, mcap_ros2.decoder)
    _, fast = read(recording, mcap_ros2_support_fast)
    shorter = len(raw) - len(bytes(encode(detection(frame))))
    print(f'{frame}: the box is at {usual}, by the fast decoder at {fast}')
    print(f'  the fast encoder leaves out {shorter} of {len(raw)} bytes')
    results[frame] = usual, fast, shorter
sys.exit(
    not (
        results['camera'] == ((1.0, 2.0, 3.0), (1.0, 2.0, 3.0), 0)
        and results['lidar_top'][0] == (1.0, 2.0, 3.0)
        and max(results['lidar_top'][1]) < 1e-300
        and results['lidar_top'][2] == 4
    )
)
PROGRAM
