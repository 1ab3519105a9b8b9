"""The viewer: a process that receives the stream and draws it in Rerun."""
