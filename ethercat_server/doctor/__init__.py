"""`ethercat-doctor`: finds causes of latency and lost samples on machine and bus, and how to fix them."""
