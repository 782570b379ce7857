//! Keeps the moments around triggers.
