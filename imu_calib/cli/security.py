"""imu-calib security: the keystore with which a stand's nodes prove their identity."""

from __future__ import annotations

import argparse

from ..common.files import user_path
from ..live.network import enclave, make_keystore
from .terminal import OUTPUT


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the subcommand."""
    parser.add_argument('keystore', metavar='KEYSTORE', help='folder to create or update')
    parser.add_argument(
        '--namespace', default='', metavar='NAME', help='ROS domain of the nodes of the stand'
    )
    parser.add_argument(
        '--policy', metavar='FILE', help='policy of your own (default: config/security/policy.xml)'
    )
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    """Create the keystore, and print how to use it.

    Raises:
        ImuCalibError: sros2 is not installed, or the keystore cannot be created.
    """
    keystore = user_path(arguments.keystore).absolute()
    policy = None if arguments.policy is None else user_path(arguments.policy)
    enclaves = make_keystore(keystore, arguments.namespace, policy)
    OUTPUT.print(f'{keystore} holds the keys of:', markup=False)
    for name in enclaves:
        OUTPUT.print(f'  {name}', markup=False)
    OUTPUT.print(
        f'Where nodes of the stand run:\n  export ROS_SECURITY_KEYSTORE={keystore} '
        'ROS_SECURITY_ENABLE=true ROS_SECURITY_STRATEGY=Enforce\nand in the terminal of the person '
        'who leads the stand:\n  export '
        f'ROS_SECURITY_ENCLAVE_OVERRIDE={enclave("operator")}\n{keystore / "private"} signs the '
        'keys that the stand trusts: keep it on a machine where no node runs.',
        markup=False,
        soft_wrap=True,
    )
