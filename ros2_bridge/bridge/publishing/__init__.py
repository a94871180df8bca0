"""From samples to messages: topics and their serialized messages, and the compensated wrench."""
