"""Procedural cavities of many kinds, to pretrain the restorer on; none of them is ever evaluated."""
