#!/usr/bin/env bash
# README's two commands, `simulate` and `calibrate` on a bare machine: Debian unstable with one of its Pythons,
# in a chroot that goes when they end. Needs root and mmdebstrap; for a foreign processor (arm64) also
# qemu-user-static, and binfmt_misc mounted. The packages of Python come as wheels alone.
#
#     .ci/bare_machines.sh ARCHITECTURE PYTHON [ARGUMENTS OF PYTEST]
#
# Without arguments the whole suite runs; on a foreign processor, where it would take a day, none of it.
# What was seen: docs/machines.md.
set -euo pipefail
cd "$(dirname "$0")/.."
architecture=${1:?'amd64, arm64, ...'} python=${2:?'3.14, ...'}
shift 2

command_of() {
  sed -n "/<!-- $1 -->/,/<!-- end -->/p" README.md | grep -v -e '<!--' -e '```'
}

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
git archive --prefix=srv/imu_calib/ --output="$folder/checkout.tar" HEAD
suite="$(command_of 'the test command') ${*@Q}"
if [ "$architecture" != "$(dpkg --print-architecture)" ] && [ $# = 0 ]; then
  suite='echo Of the suite nothing was run.'
fi
cat > "$folder/steps" << END
set -euxo pipefail
cd /srv/imu_calib
ln -s /usr/bin/python$python /usr/local/bin/python3
uname -m
python3 --version
$(command_of 'the main job')
.venv/bin/pip list
.venv/bin/imu-calib simulate six_position -o recording
.venv/bin/imu-calib calibrate recording -o recording.yaml
$suite
END

# Of this machine its way to the package indices, and nothing else. Compiled is what is loaded.
mapfile -t way < <(env | grep -i -e '^PIP_' -e '^[a-z]*_proxy=')
hooks=()
for file in /etc/pip.conf /etc/ssl/certs/ca-certificates.crt; do
  [ ! -e "$file" ] || hooks+=(--customize-hook="copy-in $file $(dirname "$file")")
done
# The processor of a Raspberry Pi 4: with vectors of SVE, which qemu 7.2 has by default, numpy 2.5.5 inverts
# matrices wrongly.
way+=(QEMU_CPU=cortex-a72)
# The Release file of unstable is valid for a week; a mirror may be older.
env -i "${way[@]}" PIP_ONLY_BINARY=:all: PIP_NO_COMPILE=1 PATH="$PATH" HOME=/tmp LANG=C.UTF-8 \
  mmdebstrap --format=null --variant=apt --architectures="$architecture" \
  --aptopt='Acquire::Check-Valid-Until "false"' --include="ca-certificates,python$python-venv" "${hooks[@]}" \
  --customize-hook='echo 127.0.0.1 localhost > "$1/etc/hosts"' \
  --customize-hook="tar-in $folder/checkout.tar /" \
  --customize-hook="copy-in $folder/steps /srv" \
  --customize-hook='chroot "$1" bash /srv/steps' \
  unstable
