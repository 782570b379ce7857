//! Place of a frame in a tensor, and the way back from the tensor to the frame.

/// Largest width and height of a tensor, in pixels.
pub const MAX_TENSOR_SIDE: u32 = 8192;

/// Place of a frame in the input tensor of a model.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Placement {
    /// The frame is stretched to the whole tensor.
    Stretch,
    /// The aspect ratio is kept; the frame is in the middle, with a border around it.
    Centre,
    /// The aspect ratio is kept; the frame is in the upper left corner.
    Corner,
}

/// Place of a prepared frame in its tensor: pixel `x` of the frame is at `x * scale_x + left`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Placed {
    /// Pixels of the tensor per pixel of the frame, across.
    pub scale_x: f32,
    /// Pixels of the tensor per pixel of the frame, down.
    pub scale_y: f32,
    /// Pixels left of the frame.
    pub left: f32,
    /// Pixels above the frame.
    pub top: f32,
    /// Width of the frame in pixels.
    pub frame_width: u32,
    /// Height of the frame in pixels.
    pub frame_height: u32,
    /// Width of the tensor in pixels.
    pub tensor_width: u32,
    /// Height of the tensor in pixels.
    pub tensor_height: u32,
}

impl Placed {
    /// Returns the position in the frame of the position (`x`, `y`) in the tensor. It may be
    /// outside of the frame.
    pub fn to_frame(&self, x: f32, y: f32) -> (f32, f32) {
        ((x - self.left) / self.scale_x, (y - self.top) / self.scale_y)
    }

    /// Returns the position in the tensor of the position (`x`, `y`) in the frame.
    pub fn to_tensor(&self, x: f32, y: f32) -> (f32, f32) {
        (x * self.scale_x + self.left, y * self.scale_y + self.top)
    }

    /// Returns whether all numbers can be used.
    pub(crate) fn is_valid(&self) -> bool {
        let numbers = [self.scale_x, self.scale_y, self.left, self.top];
        let sides = [self.frame_width, self.frame_height, self.tensor_width, self.tensor_height];
        numbers.iter().all(|number| number.is_finite())
            && self.scale_x > 0.0
            && self.scale_y > 0.0
            && !sides.contains(&0)
    }
}

/// The pixels of a tensor that the frame takes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Area {
    pub(crate) left: u32,
    pub(crate) top: u32,
    pub(crate) width: u32,
    pub(crate) height: u32,
}

impl Placement {
    /// Places a frame of `frame` in a tensor of `tensor` pixels, both (width, height) and not 0.
    ///
    /// Sources: `preproc` in `yolox/data/data_augment.py` of YOLOX for [`Placement::Corner`],
    /// `LetterBox` in `ultralytics/data/augment.py` for [`Placement::Centre`]. Both train and map
    /// back with the one ratio below, not with the ratio of the rounded sizes, so this does too.
    pub(crate) fn place(self, frame: (u32, u32), tensor: (u32, u32)) -> (Area, Placed) {
        let (across, down) =
            (f64::from(tensor.0) / f64::from(frame.0), f64::from(tensor.1) / f64::from(frame.1));
        let ratio = across.min(down);
        // A thin frame keeps one pixel.
        let side = |rounded: f64, limit: u32| (rounded as u32).clamp(1, limit);
        let (width, height) = (f64::from(frame.0) * ratio, f64::from(frame.1) * ratio);
        let (area, scale) = match self {
            Self::Stretch => {
                (Area { left: 0, top: 0, width: tensor.0, height: tensor.1 }, (across, down))
            }
            Self::Corner => {
                let (width, height) = (side(width, tensor.0), side(height, tensor.1));
                (Area { left: 0, top: 0, width, height }, (ratio, ratio))
            }
            Self::Centre => {
                let width = side(width.round_ties_even(), tensor.0);
                let height = side(height.round_ties_even(), tensor.1);
                // `round(border / 2 - 0.1)` of Ultralytics: of an odd border, the larger half is
                // on the right and below.
                let (left, top) = ((tensor.0 - width) / 2, (tensor.1 - height) / 2);
                (Area { left, top, width, height }, (ratio, ratio))
            }
        };
        let placed = Placed {
            scale_x: scale.0 as f32,
            scale_y: scale.1 as f32,
            left: area.left as f32,
            top: area.top as f32,
            frame_width: frame.0,
            frame_height: frame.1,
            tensor_width: tensor.0,
            tensor_height: tensor.1,
        };
        (area, placed)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn area(placement: Placement, frame: (u32, u32), tensor: (u32, u32)) -> [u32; 4] {
        let (area, _) = placement.place(frame, tensor);
        [area.left, area.top, area.width, area.height]
    }

    #[test]
    fn a_stretched_frame_takes_the_whole_tensor() {
        assert_eq!(area(Placement::Stretch, (640, 427), (416, 416)), [0, 0, 416, 416]);
        assert_eq!(area(Placement::Stretch, (1, 1), (8192, 1)), [0, 0, 8192, 1]);
    }

    #[test]
    fn a_frame_in_the_corner_has_its_sides_rounded_down_as_in_yolox() {
        // 427 * 0.65 = 277.55
        assert_eq!(area(Placement::Corner, (640, 427), (416, 416)), [0, 0, 416, 277]);
        assert_eq!(area(Placement::Corner, (427, 640), (416, 416)), [0, 0, 277, 416]);
        assert_eq!(area(Placement::Corner, (1920, 1080), (640, 640)), [0, 0, 640, 360]);
    }

    #[test]
    fn a_frame_in_the_middle_is_rounded_to_nearest_and_has_the_odd_row_below() {
        // 427 * 0.5 = 213.5, and 213 is odd: 320 - 214 = 106 rows of border.
        assert_eq!(area(Placement::Centre, (640, 427), (320, 320)), [0, 53, 320, 214]);
        // 425 * 0.5 = 212.5: to even, 212, and 54 + 54.
        assert_eq!(area(Placement::Centre, (640, 425), (320, 320)), [0, 54, 320, 212]);
        // 100 - 55 = 45 columns of border: 22 + 23.
        assert_eq!(area(Placement::Centre, (55, 100), (100, 100)), [22, 0, 55, 100]);
        for border in 0..4000 {
            let rounded = (f64::from(border) / 2.0 - 0.1).round_ties_even();
            assert_eq!(f64::from(border / 2), rounded, "{border}");
        }
    }

    #[test]
    fn a_thin_frame_keeps_a_pixel() {
        for placement in [Placement::Corner, Placement::Centre] {
            let [_, _, width, height] = area(placement, (1, 65_535), (416, 416));
            assert_eq!((width, height), (1, 416));
            let [_, _, width, height] = area(placement, (65_535, 1), (32, 32));
            assert_eq!((width, height), (32, 1));
        }
    }

    #[test]
    fn positions_return_from_the_tensor_to_the_frame() {
        for placement in [Placement::Stretch, Placement::Centre, Placement::Corner] {
            for frame in [(1920, 1080), (640, 427), (1, 1), (7, 65_535)] {
                let (_, placed) = placement.place(frame, (416, 320));
                let (width, height) = (frame.0 as f32, frame.1 as f32);
                for (x, y) in [(0.0, 0.0), (width, height), (width / 3.0, height / 7.0)] {
                    let (u, v) = placed.to_tensor(x, y);
                    let (back_x, back_y) = placed.to_frame(u, v);
                    // The border in front of a thin frame costs digits.
                    assert!((back_x - x).abs() <= 1e-4 * width.max(height), "{back_x} {x}");
                    assert!((back_y - y).abs() <= 1e-4 * width.max(height), "{back_y} {y}");
                }
            }
        }
    }
}
