"""What a robot does with a stream of clouds and odometry, without ROS."""
