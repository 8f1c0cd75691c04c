"""The published methods: parameters as linear maps of mean outputs."""
