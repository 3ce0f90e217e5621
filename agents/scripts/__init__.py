"""Scripted attacks, their triggers, and programs from YAML files."""
