//! Operations on frames that the host computes for lambdas.
//!
//! The modules compute grey levels (`luma`) and sizes (`resize`), and convert pixels of each
//! encoding (`pixels`). Every operation can be stopped between rows ([`View::with_stop_check`]).
//! All of it is exact integer arithmetic on a validated [`View`], so that every CPU and every call
//! gives the same result, regardless of optimisations.
//!
//! Memory grows only with the width of the image. There is no result for raw (Bayer) images, whose
//! pixels have no colour until they are debayered.

mod luma;
mod pixels;
mod resize;
mod rounded;

pub use luma::{histogram, mean_luma, to_gray};
pub use resize::{MAX_RESIZED_SIDE, resize, resize_work, resized};

use super::{PixelError, Roi, View};

/// Returns the number of bytes that [`mean_luma`], [`histogram`] or [`to_gray`] reads, as its cost.
///
/// # Errors
///
/// [`PixelError::Roi`] if no pixel of the image is in `roi`.
pub fn work(view: &View<'_>, roi: Option<Roi>) -> Result<u64, PixelError> {
    let roi = view.clip(roi)?;
    Ok(u64::from(roi.width) * u64::from(roi.height) * view.encoding().bytes_per_pixel() as u64)
}

/// Returns pseudo-random bytes, the same in every run.
#[cfg(test)]
fn noise(mut state: u32, len: usize) -> Vec<u8> {
    let next = || {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (state >> 24) as u8
    };
    std::iter::repeat_with(next).take(len).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pixels::Encoding;

    #[test]
    fn work_is_the_bytes_of_the_pixels_without_padding() {
        let view = View::new(4, 3, 100, Encoding::Rgb8, false, &[0; 300]).unwrap();
        let roi = |x, y, width, height| Some(Roi { x, y, width, height });
        assert_eq!(work(&view, None).unwrap(), 36);
        assert_eq!(work(&view, roi(2, 1, 9, 1)).unwrap(), 6);
        assert!(work(&view, roi(4, 0, 1, 1)).is_err());
    }
}
