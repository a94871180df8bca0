"""The network interface: what the kernel says of it, and the claim that keeps other masters of ours away."""
