"""Designs for the programs that run robots: ROS 2, LeRobot, and a player in plain Python."""
