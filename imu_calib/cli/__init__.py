"""The command `imu-calib`: one module per subcommand, each a parser and a thin function."""
