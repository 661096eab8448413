"""ROS 1 and ROS 2 bags through ``rosbags``: no ROS installation is needed."""
