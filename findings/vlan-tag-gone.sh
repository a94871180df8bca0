#!/usr/bin/env bash
# Linux packet socket of one EtherType: it receives frames of any VLAN, and nothing in them says so.
#
# One would guess: a frame with a VLAN tag has EtherType 0x8100, so a socket that is bound to 0x88A4 does not see it;
# or if the kernel takes the tag off, that PACKET_AUXDATA tells of it, as packet(7) has it and as tcpdump shows.
# What happens: where no interface of that VLAN exists, the kernel takes the tag off and delivers the rest as 0x88A4.
# The bytes are those of an untagged frame, auxdata has no tag, not even the flag that there was one; only the packet
# type of recvfrom's address has changed, from broadcast to "other host". A socket for all protocols (tcpdump's) has
# the tag. A user meets it on a trunk port: an EtherCAT master takes another segment's datagrams for its own, while a
# capture beside it shows them apart. Seen with Linux 6.18 on veth. Needs root (a network namespace); 77 without.
set -euo pipefail
[ "$(id -u)" = 0 ] || { echo "needs root for a network namespace"; exit 77; }
[ "${1-}" = inside ] || exec unshare --net "$0" inside
ip link add left type veth peer name right
ip link set left up
ip link set right up
echo "Linux $(uname -r)"
python3 - <<'END'
import socket, struct, time

ETH_P_ALL, ETH_P_8021Q, ETHERCAT, VLAN = 3, 0x8100, 0x88A4, 7
SOL_PACKET, PACKET_AUXDATA = 263, 8
TP_STATUS_VLAN_VALID = 1 << 4
TYPES = {1: "broadcast", 3: "other host"}
time.sleep(0.3)
sender = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0)
sender.bind(("left", 0))

def listen(protocol: int) -> socket.socket:
    receiver = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0)
    receiver.setsockopt(SOL_PACKET, PACKET_AUXDATA, 1)
    receiver.bind(("right", protocol))
    receiver.settimeout(0.5)
    return receiver

def received(receiver: socket.socket) -> tuple[str, str, str]:
    """EtherType in the frame, VLAN by auxdata, packet type."""
    while True:
        frame, ancillary, _, address = receiver.recvmsg(200, 100)
        if b"datagram" in frame:
            break
    status, *_, tci, _ = struct.unpack("=IIIHHHH", ancillary[0][2])
    vlan = str(tci & 0xFFF) if status & TP_STATUS_VLAN_VALID else "none"
    return hex(int.from_bytes(frame[12:14], "big")), vlan, TYPES.get(address[2], str(address[2]))

one, every = listen(ETHERCAT), listen(ETH_P_ALL)
addresses = b"\xff" * 6 + bytes.fromhex("020000000001")
seen = {}
for name, tag in (("untagged", b""), ("of VLAN 7", struct.pack(">HH", ETH_P_8021Q, VLAN))):
    sender.send((addresses + tag + ETHERCAT.to_bytes(2, "big") + b"datagram").ljust(64, b"\0"))
    for who, receiver in (("bound to 0x88A4", one), ("for all protocols", every)):
        seen[name, who] = received(receiver)
        ethertype, vlan, kind = seen[name, who]
        print(f"sent {name}, socket {who}: EtherType {ethertype}, VLAN by auxdata {vlan}, packet type {kind}")
assert seen["untagged", "bound to 0x88A4"] == ("0x88a4", "none", "broadcast")
assert seen["of VLAN 7", "bound to 0x88A4"] == ("0x88a4", "none", "other host"), "the behavior has changed"
assert seen["of VLAN 7", "for all protocols"][1] == "7", "the behavior has changed"
END
