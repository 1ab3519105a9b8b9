"""Many runs: cells of a study, spread over processes, each result kept by the digest of what made it."""
