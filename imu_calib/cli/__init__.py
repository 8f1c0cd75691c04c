"""The command `imu-calib`: one module per subcommand, each with a parser and a function."""
