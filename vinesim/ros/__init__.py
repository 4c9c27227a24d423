"""ROS 2 in process: the only room that imports rclpy or message packages."""
