"""Policies for all levels: cloning, reinforcement, teachers, and evaluation."""
