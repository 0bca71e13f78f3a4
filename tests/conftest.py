"""Modules beside this file, such as ``bench_session``, can be imported by tests of any folder."""
