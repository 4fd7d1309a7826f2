"""CALVIN demonstrations as LeRobotDatasets: `lansar-convert` or `python -m dataset_convert`."""
