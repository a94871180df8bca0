"""/diagnostics: `observer` and `server_status` sum up, `health` judges (no ROS), `monitor` publishes."""
