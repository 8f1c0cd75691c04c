"""The DDS participant of a process and its topics."""

from __future__ import annotations

from typing import Any

from ....common.errors import ImuCalibError
from ..running import configuration


class TransportError(Exception):
    """Endpoints were deleted, or the participant has left, while waiting for messages."""


def delete(entity: Any) -> None:
    """Delete an entity of the wheel now, without waiting for its last reference to end."""
    entity.__del__()


class Participant:
    """One process in a domain.

    Args:
        number: The domain.

    Raises:
        ImuCalibError: Cyclone DDS cannot join it.
    """

    def __init__(self, number: int) -> None:
        from cyclonedds.core import DDSException
        from cyclonedds.domain import Domain, DomainParticipant
        from cyclonedds.qos import Policy, Qos

        self._topics: dict[str, Any] = {}
        self._has_left = False
        domain: Any = None
        try:
            domain = Domain(number, configuration())
            self.entity: Any = DomainParticipant(number, Qos(Policy.Userdata(b'enclave=/;')))
        except DDSException as error:
            if domain is not None:
                delete(domain)
            raise ImuCalibError(
                f'Cyclone DDS cannot join domain {number}: {error}. ROS_AUTOMATIC_DISCOVERY_RANGE '
                'and CYCLONEDDS_URI say which network interfaces it may use.'
            ) from error
        self._domain = domain

    def ok(self) -> bool:
        """Return whether it is still in the domain."""
        return not self._has_left

    def topic(self, name: str, idl: Any) -> Any:
        """Return the DDS topic of a name; it is created once.

        Raises:
            ImuCalibError: It has another type already, or cannot be created.
        """
        from cyclonedds.core import DDSException
        from cyclonedds.topic import Topic

        if name not in self._topics:
            try:
                self._topics[name] = Topic(self.entity, name, idl)
            except DDSException as error:
                raise ImuCalibError(f'The topic {name} cannot be made: {error}') from error
        known = self._topics[name].data_type
        if known is not idl:
            raise ImuCalibError(
                f'The topic {name} has the type {known.__idl_typename__}, '
                f'not {idl.__idl_typename__}.'
            )
        return self._topics[name]

    def leave(self) -> None:
        """Delete all entities."""
        self._has_left = True
        for entity in (*self._topics.values(), self.entity, self._domain):
            delete(entity)
