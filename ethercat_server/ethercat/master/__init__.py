"""Masters that take sensors to OP: pysoem, and single datagrams where other devices share the wire."""
