"""Commands as child processes, and a stock ROS node that listens to them: for demonstrations and benchmarks."""
