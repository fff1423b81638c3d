"""dexgrasp for ROS 2: `messages` and `planning` are pure Python, `node` imports rclpy when it starts."""
