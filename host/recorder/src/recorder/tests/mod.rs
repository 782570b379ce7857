//! Tests of the recorder, by its clips.

mod clips;
mod in_the_way;
mod late;
mod limits;
mod live;
mod preroll;
pub mod support;
mod windows;
