"""All candidates tested and ranked at one fit."""
