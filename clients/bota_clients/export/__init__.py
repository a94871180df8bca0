"""`ethercat-export`: a recording as CSV, or as windows of samples before each camera frame."""
