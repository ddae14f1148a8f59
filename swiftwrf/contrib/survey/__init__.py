"""What a site survey asks beside its maps: where receivers are, and where a further one belongs."""
