"""Other people's grasps: one format a module, all of them read into `GraspSet`."""
