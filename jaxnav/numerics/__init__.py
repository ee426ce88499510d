"""Small matrices, trees and least squares."""
