"""What command lines say of an interface, for --help, which need not load what uses one."""

from __future__ import annotations

from typing import Final

VIRTUAL_INTERFACE: Final = "virtual"  # what stands for a virtual bus with a virtual sensor on it
# The option that has a program use an interface with a route to elsewhere or a leased address.
ALLOW_IP: Final = "--allow-ip"
ALLOW_IP_HELP: Final = "use IFACE although it has a route to elsewhere or an IP address by DHCP"
