"""Programs that are clients of the server or read recordings.

They stand on top: they import `protocol`, and some of them the server's serving half or a part of the
bridge that needs no ROS. Nothing imports them. docs/architecture.md says which of them may import what.
"""
