"""Variants, rivals and tools around the core: nothing of `swiftwrf` outside this package imports it, except by name.

Implementations are named in the registries of `swiftwrf.choices` or register themselves. The packages `swiftwrf`,
`swiftwrf.rssi` and `swiftwrf.locate` offer names of this package, which are imported at their first use.
"""
