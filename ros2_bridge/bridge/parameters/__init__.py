"""One table of parameters (`row`, `table`, `compensation`: no ROS), and how ROS declares and sets them."""
